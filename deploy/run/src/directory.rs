//! The run directory: the files of a run, and how they are created, opened and read.
//!
//! ```text
//! config.toml        resolved, for use with --config       spec.json           the environment
//! manifest.json      format, versions, machine, command    metrics.jsonl       every scalar
//! evaluations.jsonl  one row per evaluation                policies/V.safetensors
//! checkpoints/       written by the learner                logs/PROCESS.log
//! videos/  plots/                                          lock  lease.N       held while running
//! motion.json        motion of the latest policy, measured on request
//! processes.json     state of each process, during training
//! demonstrations-N.npz  converted from a data set of another format when the run was created
//! segments.log       segments since the last checkpoint, at delivery level `log`
//! provenance.json    proof that this user made the run, if it needs code of the user's own
//! ```
//! The supervisor creates it; learner and evaluator write into it; `eval` and `resume` read it.
//! A file is replaced by writing a temporary file, syncing and renaming it, so a crash leaves
//! the old one.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::{ExperimentConfig, Layers};
use dmprl_shared::spec::EnvSpec;

use crate::atomic;
use crate::failure::wrong_use;
use crate::lock::{self, Holder, RunLock};
use crate::manifest::Manifest;

/// Maximum length of the last component of a run directory's path, which becomes part of file and
/// plot names.
const NAME_LEN_MAX: usize = 128;
/// Folders that every run directory has.
pub(crate) const FOLDERS: [&str; 5] = ["checkpoints", "policies", "logs", "videos", "plots"];
/// Maximum size of a configuration, manifest or other small file. A larger one was not written by
/// this program.
const SMALL_FILE_BYTES_MAX: u64 = 4 << 20;

/// An existing run directory, of the format that this program reads.
#[derive(Debug, Clone)]
pub struct RunDirectory {
    path: PathBuf,
}

/// File with the secret for other hosts, unless the configuration names another one.
pub const TOKEN_FILE: &str = "bridge.token";

impl RunDirectory {
    /// Rejects a path that [`RunDirectory::create`] would reject, before any long work.
    ///
    /// # Errors
    /// Wrong use: an invalid name, an existing file, or a directory that is not empty.
    pub fn check_free(path: &Path) -> anyhow::Result<()> {
        check_name(path)?;
        let Ok(metadata) = fs::metadata(path) else { return Ok(()) };
        if !metadata.is_dir() {
            return Err(wrong_use(format!("run directory {} is a file", path.display())));
        }
        let mut entries =
            fs::read_dir(path).with_context(|| format!("cannot read {}", path.display()))?;
        // The secret for other hosts may exist before the run.
        let is_file = |entry: std::io::Result<fs::DirEntry>| {
            entry.map_or(true, |entry| entry.file_name() != TOKEN_FILE)
        };
        if entries.any(is_file) {
            let path = path.display();
            return Err(wrong_use(format!(
                "run directory {path} already holds files; choose another --run-dir, or resume \
                 that run: dmprl resume {path}"
            )));
        }
        Ok(())
    }

    /// Creates the directory with its folders, `config.toml` and `manifest.json`.
    ///
    /// # Errors
    /// As [`RunDirectory::check_free`], or an I/O error.
    pub fn create(
        path: &Path,
        config: &ExperimentConfig,
        manifest: &Manifest,
    ) -> anyhow::Result<Self> {
        Self::check_free(path)?;
        fs::create_dir_all(path)
            .with_context(|| format!("cannot create the run directory {}", path.display()))?;
        let path =
            fs::canonicalize(path).with_context(|| format!("cannot resolve {}", path.display()))?;
        for folder in FOLDERS {
            fs::create_dir(path.join(folder))
                .with_context(|| format!("cannot create {folder} in {}", path.display()))?;
        }
        let run = Self { path };
        for file in [run.metrics_path(), run.evaluations_path()] {
            fs::File::create_new(&file)
                .with_context(|| format!("cannot create {}", file.display()))?;
        }
        run.write_config(config)?;
        // Last: a directory with a manifest is complete.
        run.write_manifest(manifest)?;
        Ok(run)
    }

    /// Opens a run directory.
    ///
    /// # Errors
    /// Wrong use: it does not exist or has no manifest. Also an error if the manifest is damaged or
    /// of another format.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        if !path.is_dir() {
            return Err(wrong_use(format!("there is no run directory {}", path.display())));
        }
        if !path.join("manifest.json").is_file() {
            return Err(wrong_use(format!(
                "{} is not a run directory: it has no manifest.json",
                path.display()
            )));
        }
        let path =
            fs::canonicalize(path).with_context(|| format!("cannot resolve {}", path.display()))?;
        let run = Self { path };
        run.manifest()?;
        Ok(run)
    }

    /// Absolute path of the directory.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the resolved configuration.
    ///
    /// # Errors
    /// `config.toml` is missing, too large or invalid.
    pub fn config(&self) -> anyhow::Result<ExperimentConfig> {
        let path = self.path.join("config.toml");
        let table = read_small(&path)?
            .parse()
            .with_context(|| format!("{} is not valid TOML", path.display()))?;
        let mut layers = Layers::new();
        // Runs that are older than this key executed whole segments.
        layers.set("defaults", "policy.execution", "segment")?;
        layers.add(&path.display().to_string(), table)?;
        Ok(layers.finish()?)
    }

    /// Replaces `config.toml`, as `resume --steps` does.
    ///
    /// # Errors
    /// An I/O error.
    pub fn write_config(&self, config: &ExperimentConfig) -> anyhow::Result<()> {
        let text = toml::to_string(config).context("cannot write the configuration as TOML")?;
        let head = "# The resolved configuration of this run; use it again with --config.\n";
        atomic::replace(&self.path.join("config.toml"), format!("{head}{text}").as_bytes())
    }

    /// Reads the environment's specification; `None` before the first worker has reported it.
    ///
    /// # Errors
    /// `spec.json` exists, but cannot be read or is inconsistent.
    pub fn spec(&self) -> anyhow::Result<Option<EnvSpec>> {
        let path = self.path.join("spec.json");
        if !path.exists() {
            return Ok(None);
        }
        let spec: EnvSpec = serde_json::from_str(&read_small(&path)?)
            .with_context(|| format!("{} is damaged", path.display()))?;
        spec.check()?;
        Ok(Some(spec))
    }

    /// Writes `spec.json`.
    ///
    /// # Errors
    /// The specification is inconsistent, or an I/O error.
    pub fn write_spec(&self, spec: &EnvSpec) -> anyhow::Result<()> {
        spec.check()?;
        let mut text = serde_json::to_string_pretty(spec).context("cannot write spec.json")?;
        text.push('\n');
        atomic::replace(&self.path.join("spec.json"), text.as_bytes())
    }

    /// Reads the manifest.
    ///
    /// # Errors
    /// `manifest.json` is damaged or of another format.
    pub fn manifest(&self) -> anyhow::Result<Manifest> {
        let path = self.path.join("manifest.json");
        Manifest::parse(&read_small(&path)?)
            .with_context(|| format!("cannot use {}", path.display()))
    }

    /// Replaces `manifest.json`.
    ///
    /// # Errors
    /// An I/O error.
    pub fn write_manifest(&self, manifest: &Manifest) -> anyhow::Result<()> {
        let mut text = serde_json::to_string_pretty(manifest).context("cannot write manifest")?;
        text.push('\n');
        atomic::replace(&self.path.join("manifest.json"), text.as_bytes())
    }

    /// Path of the metrics, one JSON object per line; written by the learner.
    #[must_use]
    pub fn metrics_path(&self) -> PathBuf {
        self.path.join("metrics.jsonl")
    }

    /// Path of the evaluations, one row each; written by [`RunDirectory::append_evaluation`].
    #[must_use]
    pub fn evaluations_path(&self) -> PathBuf {
        self.path.join("evaluations.jsonl")
    }

    /// Path of the latest policy's motion; read and written by `dmprl_analysis::motion`.
    #[must_use]
    pub fn motion_path(&self) -> PathBuf {
        self.path.join("motion.json")
    }

    /// Replaces `motion.json`.
    ///
    /// # Errors
    /// An I/O error.
    pub fn write_motion(&self, text: &str) -> anyhow::Result<()> {
        atomic::replace(&self.motion_path(), text.as_bytes())
    }

    /// Path of the log of segments since the last checkpoint, at delivery level `log`; written by
    /// the learner.
    #[must_use]
    pub fn segment_log_path(&self) -> PathBuf {
        self.path.join("segments.log")
    }

    /// Folder of the learner's checkpoints.
    #[must_use]
    pub fn checkpoints_path(&self) -> PathBuf {
        self.path.join("checkpoints")
    }

    /// Returns true if there is a checkpoint to resume from. As in the learner, only the numbered
    /// names count: the link `latest` may be missing from a copy of the run.
    ///
    /// # Errors
    /// The folder cannot be read. Assuming no checkpoint would restart the run from the beginning.
    pub fn has_checkpoint(&self) -> anyhow::Result<bool> {
        Ok(!dmprl_shared::checkpoint::names(&self.checkpoints_path())?.is_empty())
    }

    /// Removes temporary files that killed processes left behind. Only the holder of the lock may
    /// call this, while the run has no other process.
    ///
    /// # Errors
    /// An I/O error.
    pub fn remove_half_written(&self) -> anyhow::Result<()> {
        let folders = ["", "policies", "checkpoints"];
        let remove = |folder: &&str| atomic::remove_temporary_files(&self.path.join(folder));
        folders.iter().try_for_each(remove)
    }

    /// Path of the log of one process of the run: its standard error.
    #[must_use]
    pub fn log_path(&self, process: &str) -> PathBuf {
        self.path.join("logs").join(format!("{process}.log"))
    }

    /// Supervisor that locked the run last; it may have ended.
    #[must_use]
    pub fn lock_holder(&self) -> Option<Holder> {
        lock::last_holder(&self.path)
    }

    /// Returns true if the run's supervisor is alive, on this machine.
    #[must_use]
    pub fn is_trained_here(&self) -> bool {
        self.lock_holder().is_some_and(|holder| holder.is_trainer_here())
    }

    /// Locks the run for this process and those it starts; see [`RunLock`].
    ///
    /// # Errors
    /// Another process is training this run, or an I/O error.
    pub fn lock(&self, wait: std::time::Duration) -> anyhow::Result<RunLock> {
        RunLock::take(&self.path, wait)
    }
}

/// Accepts a name of letters, digits, `.`, `_` and `-` that begins with a letter or digit. It is
/// safe in paths, plots and shared-memory names, and cannot leave the parent folder.
fn check_name(path: &Path) -> anyhow::Result<()> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let fits = name.len() <= NAME_LEN_MAX
        && name.starts_with(|letter: char| letter.is_ascii_alphanumeric())
        && name.chars().all(|letter| letter.is_ascii_alphanumeric() || "._-".contains(letter));
    if fits {
        return Ok(());
    }
    Err(wrong_use(format!(
        "run directory {} needs a name of 1 to {NAME_LEN_MAX} letters, digits, `.`, `_` and `-` \
         that begins with a letter or digit",
        path.display()
    )))
}

/// Turns a text, which may contain `:` or `/` or be too long, into part of a run directory's name.
#[must_use]
pub fn safe_name(text: &str) -> String {
    let safe = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    let begins = |letter: char| letter.is_ascii_alphanumeric();
    let text = &text[text.find(begins).unwrap_or(text.len())..];
    text.chars()
        .take(NAME_LEN_MAX / 2)
        .map(|letter| if safe(letter) { letter } else { '_' })
        .collect()
}

/// Reads a file of at most [`SMALL_FILE_BYTES_MAX`].
pub(crate) fn read_small(path: &Path) -> anyhow::Result<String> {
    let metadata = fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(metadata.is_file(), "{} is not a file", path.display());
    if metadata.len() > SMALL_FILE_BYTES_MAX {
        bail!(
            "{} has {} bytes; expected at most {SMALL_FILE_BYTES_MAX}",
            path.display(),
            metadata.len()
        );
    }
    fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

#[cfg(test)]
mod tests;
