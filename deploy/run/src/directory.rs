//! The run directory: everything that a run leaves behind, and the rules for reading it again.
//!
//! ```text
//! config.toml        resolved, re-usable with --config     spec.json           the environment
//! manifest.json      format, versions, machine, command    metrics.jsonl       every scalar
//! evaluations.jsonl  one row an evaluation                 policies/V.safetensors
//! checkpoints/       written by the learner                logs/PROCESS.log
//! videos/  plots/                                          lock                held while alive
//! motion.json        how the latest policy moves, once somebody has asked
//! processes.json     which processes there are and what they do, while it is trained
//! segments.log       at delivery level `log`: what came since the last checkpoint
//! ```
//! The supervisor makes it; learner and evaluator write into it; `eval`, `resume` read it.
//! Files that are replaced are written aside, synced and renamed, so a crash leaves the old one.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use dmprl_shared::config::{ExperimentConfig, Layers};
use dmprl_shared::spec::EnvSpec;

use crate::atomic;
use crate::failure::wrong_use;
use crate::lock::{self, RunLock};
use crate::manifest::Manifest;

/// Longest last component of a run directory's path: it becomes part of file and plot names.
const NAME_LEN_MAX: usize = 128;
/// Folders that every run directory has.
const FOLDERS: [&str; 5] = ["checkpoints", "policies", "logs", "videos", "plots"];
/// A file longer than this is not one of ours.
const SMALL_FILE_BYTES_MAX: u64 = 4 << 20;

/// An existing run directory of a format that this program reads.
#[derive(Debug, Clone)]
pub struct RunDirectory {
    path: PathBuf,
}

/// The secret that other hosts must know, where the configuration names no other file.
pub const TOKEN_FILE: &str = "bridge.token";

impl RunDirectory {
    /// Refuses a path that [`RunDirectory::create`] would refuse, before any long work.
    ///
    /// # Errors
    /// Wrong use: an odd name, a file in the way, or a directory that holds something.
    pub fn check_free(path: &Path) -> anyhow::Result<()> {
        check_name(path)?;
        let Ok(metadata) = fs::metadata(path) else { return Ok(()) };
        if !metadata.is_dir() {
            return Err(wrong_use(format!("run directory {} is a file", path.display())));
        }
        let mut entries =
            fs::read_dir(path).with_context(|| format!("cannot read {}", path.display()))?;
        // The secret for other hosts may be there before the run.
        let is_file = |entry: std::io::Result<fs::DirEntry>| {
            entry.map_or(true, |entry| entry.file_name() != TOKEN_FILE)
        };
        if entries.any(is_file) {
            let path = path.display();
            return Err(wrong_use(format!(
                "run directory {path} already holds files; choose another --run-dir, or go on \
                 with that run: dmprl resume {path}"
            )));
        }
        Ok(())
    }

    /// Makes the directory with its folders, `config.toml` and `manifest.json`.
    ///
    /// # Errors
    /// As [`RunDirectory::check_free`], or what the file system refuses.
    pub fn create(
        path: &Path,
        config: &ExperimentConfig,
        manifest: &Manifest,
    ) -> anyhow::Result<Self> {
        Self::check_free(path)?;
        fs::create_dir_all(path)
            .with_context(|| format!("cannot make the run directory {}", path.display()))?;
        let path =
            fs::canonicalize(path).with_context(|| format!("cannot resolve {}", path.display()))?;
        for folder in FOLDERS {
            fs::create_dir(path.join(folder))
                .with_context(|| format!("cannot make {folder} in {}", path.display()))?;
        }
        let run = Self { path };
        for file in [run.metrics_path(), run.evaluations_path()] {
            fs::File::create_new(&file)
                .with_context(|| format!("cannot make {}", file.display()))?;
        }
        run.write_config(config)?;
        // Last: a directory with a manifest is a whole run directory.
        run.write_manifest(manifest)?;
        Ok(run)
    }

    /// Opens a run directory of this format or an older one.
    ///
    /// # Errors
    /// Wrong use where there is none; a newer format is refused with its version.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        if !path.is_dir() {
            return Err(wrong_use(format!("there is no run directory {}", path.display())));
        }
        if !path.join("manifest.json").is_file() {
            return Err(wrong_use(format!(
                "{} is no run directory: it has no manifest.json",
                path.display()
            )));
        }
        let path =
            fs::canonicalize(path).with_context(|| format!("cannot resolve {}", path.display()))?;
        let run = Self { path };
        run.manifest()?;
        Ok(run)
    }

    /// The directory, absolute.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The resolved configuration.
    ///
    /// # Errors
    /// `config.toml` is missing, too long, or does not fit the configuration tree.
    pub fn config(&self) -> anyhow::Result<ExperimentConfig> {
        let path = self.path.join("config.toml");
        let table =
            read_small(&path)?.parse().with_context(|| format!("{} is no TOML", path.display()))?;
        let mut layers = Layers::new();
        layers.add(&path.display().to_string(), table)?;
        Ok(layers.finish()?)
    }

    /// Replaces `config.toml`, as `resume --steps` does.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn write_config(&self, config: &ExperimentConfig) -> anyhow::Result<()> {
        let text = toml::to_string(config).context("cannot write the configuration as TOML")?;
        let head = "# The resolved configuration of this run; use it again with --config.\n";
        atomic::replace(&self.path.join("config.toml"), format!("{head}{text}").as_bytes())
    }

    /// What the environment is; none before the first worker has said so.
    ///
    /// # Errors
    /// `spec.json` exists and cannot be read, or contradicts itself.
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
    /// The specification contradicts itself, or what the file system refuses.
    pub fn write_spec(&self, spec: &EnvSpec) -> anyhow::Result<()> {
        spec.check()?;
        let mut text = serde_json::to_string_pretty(spec).context("cannot write spec.json")?;
        text.push('\n');
        atomic::replace(&self.path.join("spec.json"), text.as_bytes())
    }

    /// Who made the run, where and when.
    ///
    /// # Errors
    /// `manifest.json` is damaged or of a newer format.
    pub fn manifest(&self) -> anyhow::Result<Manifest> {
        let path = self.path.join("manifest.json");
        Manifest::parse(&read_small(&path)?)
            .with_context(|| format!("cannot use {}", path.display()))
    }

    /// Replaces `manifest.json`.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn write_manifest(&self, manifest: &Manifest) -> anyhow::Result<()> {
        let mut text = serde_json::to_string_pretty(manifest).context("cannot write manifest")?;
        text.push('\n');
        atomic::replace(&self.path.join("manifest.json"), text.as_bytes())
    }

    /// Every scalar, one object a line; written by the learner.
    #[must_use]
    pub fn metrics_path(&self) -> PathBuf {
        self.path.join("metrics.jsonl")
    }

    /// One row an evaluation; written by [`RunDirectory::append_evaluation`].
    #[must_use]
    pub fn evaluations_path(&self) -> PathBuf {
        self.path.join("evaluations.jsonl")
    }

    /// How the latest policy moves; read and written by `dmprl_analysis::motion`.
    #[must_use]
    pub fn motion_path(&self) -> PathBuf {
        self.path.join("motion.json")
    }

    /// Replaces `motion.json`.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn write_motion(&self, text: &str) -> anyhow::Result<()> {
        atomic::replace(&self.motion_path(), text.as_bytes())
    }

    /// Segments since the last checkpoint, at delivery level `log`; written by the learner.
    #[must_use]
    pub fn segment_log_path(&self) -> PathBuf {
        self.path.join("segments.log")
    }

    /// The learner's folder.
    #[must_use]
    pub fn checkpoints_path(&self) -> PathBuf {
        self.path.join("checkpoints")
    }

    /// Whether there is a checkpoint to go on from. Counted as the learner counts: by number.
    /// `latest` is for people, and copying a run without its links must not cost the run.
    ///
    /// # Errors
    /// The folder cannot be read: nobody knows then, and a run is not begun again on a guess.
    pub fn has_checkpoint(&self) -> anyhow::Result<bool> {
        Ok(!dmprl_shared::checkpoint::names(&self.checkpoints_path())?.is_empty())
    }

    /// Removes what killed processes left half-written: each replaces files by writing them aside.
    /// Only for the holder of the lock, when no other process of the run is left.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn remove_half_written(&self) -> anyhow::Result<()> {
        let folders = ["", "policies", "checkpoints"];
        folders.iter().try_for_each(|folder| atomic::remove_asides(&self.path.join(folder)))
    }

    /// The standard error of one process of the run.
    #[must_use]
    pub fn log_path(&self, process: &str) -> PathBuf {
        self.path.join("logs").join(format!("{process}.log"))
    }

    /// The process that took the run last, by its number; it may be gone.
    #[must_use]
    pub fn lock_holder(&self) -> Option<u32> {
        lock::last_holder(&self.path)
    }

    /// Whether the run's supervisor lives, on this machine.
    #[must_use]
    pub fn is_trained_here(&self) -> bool {
        self.lock_holder().is_some_and(lock::is_trainer)
    }

    /// Takes the run for this process and those it starts; see [`RunLock`].
    ///
    /// # Errors
    /// Another process trains this run.
    pub fn lock(&self, wait: std::time::Duration) -> anyhow::Result<RunLock> {
        RunLock::take(&self.path, wait)
    }
}

/// Letters, digits, `.`, `_`, `-`, beginning with a letter or digit: a name that is safe in
/// paths, plots and shared-memory names, and no way out of the parent folder.
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

/// Part of a run directory's name from text that may hold `:`, `/` or more than fits.
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

pub(crate) fn read_small(path: &Path) -> anyhow::Result<String> {
    let metadata = fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(metadata.is_file(), "{} is no file", path.display());
    if metadata.len() > SMALL_FILE_BYTES_MAX {
        bail!(
            "{} holds {} bytes; expected at most {SMALL_FILE_BYTES_MAX}",
            path.display(),
            metadata.len()
        );
    }
    fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

#[cfg(test)]
mod tests;
