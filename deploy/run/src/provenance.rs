//! Tells this user's own runs from others, before a command imports what a run's `config.toml`
//! names.
//!
//! A run directory may come from anyone, so nothing in it is proof by itself. `train` therefore
//! writes a keyed hash into it, `provenance.json`, over the run's id and the code that the
//! configuration names. The key is in the user's state directory and never leaves it.

use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_shared::config::{ExperimentConfig, TaskConfig};
use hmac::{Hmac, Mac};
use serde::{Deserialize, Serialize};
use sha2::Sha256;

use crate::atomic;
use crate::directory::{RunDirectory, read_small};
use crate::manifest::hexadecimal;
use crate::secret_file;

/// Version of the file's format, and of the hashed fields.
const FORMAT: u32 = 1;
/// The file in the run directory.
const FILE: &str = "provenance.json";
/// The user's key, below the state directory.
const KEY: &str = "dmprl/key";
/// Module of ids of the built-in tasks, as Gymnasium accepts them.
const OWN_MODULE: &str = "dmprl";
/// Ends the message of a wrong key.
const REMEDY: &str = "remove it, and the next train makes a new one; runs of your own modules then \
                      ask once for --trust-code";

/// Content of the file.
#[derive(Debug, Serialize, Deserialize)]
struct Provenance {
    format: u32,
    /// HMAC-SHA256 in hexadecimal.
    tag: String,
}

/// Argument of an environment that cannot name code.
const HARMLESS_ARGUMENT: &str = "max_episode_steps";

/// Code that the environments of a configuration import, beyond dmprl and registered Gymnasium ids.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedCode {
    /// Modules of `task.id` and `task.wrappers`.
    pub modules: Vec<String>,
    /// `task.python_path`.
    pub folders: Vec<PathBuf>,
    /// `task.kwargs`, as TOML values by name. Some environments import a module or read a file that
    /// an argument names.
    pub arguments: Vec<String>,
}

impl NamedCode {
    /// Returns the code that a configuration names; `None` if it names none, as with a built-in
    /// task.
    #[must_use]
    pub fn of(config: &ExperimentConfig) -> Option<Self> {
        let TaskConfig { python_path, kwargs, .. } = &config.task;
        let modules = config.task.imports().into_iter().filter(|module| *module != OWN_MODULE);
        let arguments = kwargs.iter().filter(|(name, _)| *name != HARMLESS_ARGUMENT);
        let code = Self {
            modules: modules.map(str::to_owned).collect(),
            folders: python_path.iter().map(PathBuf::from).collect(),
            arguments: arguments.map(|(name, value)| format!("{name} = {value}")).collect(),
        };
        let is_empty =
            code.modules.is_empty() && code.folders.is_empty() && code.arguments.is_empty();
        (!is_empty).then_some(code)
    }
}

impl RunDirectory {
    /// Records that this user trusts the code that `config` names. Creates the user's key if there
    /// is none.
    ///
    /// # Errors
    /// There is no home directory, or the key or the file cannot be written.
    pub fn mark_as_own(&self, config: &ExperimentConfig) -> anyhow::Result<()> {
        self.mark(&key_path()?, config)
    }

    /// Returns true if this user made the run with the code that `config` names, or has trusted it.
    ///
    /// # Errors
    /// The run or the user's key cannot be read.
    pub fn is_own(&self, config: &ExperimentConfig) -> anyhow::Result<bool> {
        key_path().map_or(Ok(false), |key| self.is_marked(&key, config))
    }

    fn mark(&self, key: &Path, config: &ExperimentConfig) -> anyhow::Result<()> {
        let folder = key.parent().context("the key has no folder")?;
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
        let key = secret_file::ensure(key, REMEDY)?;
        let provenance = Provenance { format: FORMAT, tag: self.tag(&key, config)? };
        let mut text = serde_json::to_string(&provenance).context("cannot write provenance")?;
        text.push('\n');
        atomic::replace(&self.path().join(FILE), text.as_bytes())
    }

    fn is_marked(&self, key: &Path, config: &ExperimentConfig) -> anyhow::Result<bool> {
        let file = self.path().join(FILE);
        if !file.exists() || !key.exists() {
            return Ok(false);
        }
        let key = secret_file::read(key, REMEDY)?;
        let provenance: Option<Provenance> = serde_json::from_str(&read_small(&file)?).ok();
        let tag = self.tag(&key, config)?;
        Ok(provenance.is_some_and(|found| found.format == FORMAT && found.tag == tag))
    }

    fn tag(&self, key: &str, config: &ExperimentConfig) -> anyhow::Result<String> {
        let mut hash = Hmac::<Sha256>::new_from_slice(key.as_bytes()).context("unusable key")?;
        let TaskConfig { id, python_path, .. } = &config.task;
        let run_id = self.manifest()?.run_id;
        let options = config.task.options_toml();
        let fields = ["dmprl provenance 1", &run_id, id, &options];
        // With its length before each field, so that no two lists have the same bytes.
        for field in fields.into_iter().chain(python_path.iter().map(String::as_str)) {
            hash.update(&(field.len() as u64).to_le_bytes());
            hash.update(field.as_bytes());
        }
        Ok(hexadecimal(&hash.finalize().into_bytes()))
    }
}

/// Path of the user's key, by the XDG Base Directory Specification.
fn key_path() -> anyhow::Result<PathBuf> {
    let absolute =
        |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let state = absolute("XDG_STATE_HOME")
        .or_else(|| absolute("HOME").map(|home| home.join(".local/state")));
    Ok(state.context("neither XDG_STATE_HOME nor HOME is set")?.join(KEY))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::manifest::Manifest;

    fn config(id: &str, python_path: &[&str]) -> ExperimentConfig {
        let mut config = ExperimentConfig::default();
        config.task.id = id.to_owned();
        config.task.python_path = python_path.iter().map(|&path| path.to_owned()).collect();
        config
    }

    #[test]
    fn only_code_beyond_the_built_in_tasks_is_named() {
        for id in ["Reacher-v5", "dmprl/PandaReach-v0", "dmprl:dmprl/PandaReach-v0", "ALE/Pong-v5"]
        {
            assert_eq!(NamedCode::of(&config(id, &[])), None, "{id}");
        }
        let named = |id: &str, path: &[&str]| NamedCode::of(&config(id, path)).unwrap();
        assert_eq!(named("os:abort", &[]).modules, ["os"]);
        assert_eq!(named("dmprl.play:main", &[]).modules, ["dmprl.play"]);
        assert_eq!(named("a.b:c/D-v0", &["/x"]).modules, ["a.b"]);
        // A package may import an optional one that only this folder has.
        assert_eq!(named("Reacher-v5", &["/x"]).folders, [Path::new("/x")]);
        let mut wrapped = config("Reacher-v5", &[]);
        wrapped.task.wrappers = vec!["evil:Wrapper".to_owned()];
        assert_eq!(NamedCode::of(&wrapped).unwrap().modules, ["evil"]);
        let mut argued = config("GymV26Environment-v0", &[]);
        argued.task.kwargs.insert("max_episode_steps".to_owned(), 50.into());
        assert_eq!(NamedCode::of(&argued), None);
        argued.task.kwargs.insert("env_id".to_owned(), "evil:Env-v0".into());
        assert_eq!(NamedCode::of(&argued).unwrap().arguments, ["env_id = \"evil:Env-v0\""]);
    }

    #[test]
    fn a_tag_is_valid_for_its_user_its_run_and_its_code_only() {
        let folder = tempfile::tempdir().unwrap();
        let named = config("arm:Arm-v0", &["/home/me/envs"]);
        let create = |name: &str| {
            let manifest = Manifest::new(None).unwrap();
            RunDirectory::create(&folder.path().join(name), &named, &manifest).unwrap()
        };
        let (run, other_run) = (create("run"), create("other"));
        let [key, other_key] = ["me/dmprl/key", "you/dmprl/key"].map(|it| folder.path().join(it));
        assert!(!run.is_marked(&key, &named).unwrap(), "nothing is there yet");
        run.mark(&key, &named).unwrap();
        assert!(run.is_marked(&key, &named).unwrap());
        let mut wrapped = named.clone();
        wrapped.task.wrappers = vec!["evil:Wrapper".to_owned()];
        for changed in [
            wrapped,
            config("evil:Arm-v0", &["/home/me/envs"]),
            config("arm:Arm-v0", &["/tmp/evil"]),
            config("arm:Arm-v0", &["/home/me/envs", "/tmp/evil"]),
            config("arm:Arm-v0", &["/home/me", "envs"]),
        ] {
            assert!(!run.is_marked(&key, &changed).unwrap(), "{:?}", changed.task);
        }
        // Another user, whose own run it is not, and the tag of one run in another.
        assert!(!run.is_marked(&other_key, &named).unwrap());
        other_run.mark(&other_key, &named).unwrap();
        assert!(!run.is_marked(&other_key, &named).unwrap());
        fs::copy(other_run.path().join(FILE), run.path().join(FILE)).unwrap();
        assert!(!run.is_marked(&other_key, &named).unwrap());
        fs::write(run.path().join(FILE), "{}").unwrap();
        assert!(!run.is_marked(&key, &named).unwrap());
    }
}
