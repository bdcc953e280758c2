//! Arguments that determine the configuration, shared by `train` and the benchmarks.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use clap::builder::{PossibleValuesParser, RangedI64ValueParser};
use dmprl_run::failure::wrong_use;
use dmprl_shared::config::{AlgorithmName, Device, ExperimentConfig, PRESETS, suitable_preset};
use toml::Value;

use super::configuration::{Flag, Sources};
use super::demos::is_foreign;

/// Arguments that determine the configuration.
#[derive(Debug, Args)]
pub(super) struct ConfiguredArgs {
    /// Learning algorithm.
    #[arg(long,
          value_parser = PossibleValuesParser::new(AlgorithmName::ALL.map(AlgorithmName::name)))]
    algo: Option<String>,
    /// What computes an update. auto: kernels where there are any, else a graph.
    #[arg(long, value_parser = PossibleValuesParser::new(["auto", "kernels", "graph"]))]
    backend: Option<String>,
    /// Policy type. dmp: one movement primitive per segment. mlp: one action at every step. chunk:
    /// the actions of a segment, without a primitive.
    #[arg(long, value_parser = PossibleValuesParser::new(["dmp", "mlp", "chunk"]))]
    policy: Option<String>,
    /// Named set of configuration values [default: `goal` for tasks with goals and a sparse reward,
    /// ours and those of Gymnasium-Robotics and panda-gym, else `default`].
    #[arg(long,
          value_parser = PossibleValuesParser::new(PRESETS.iter().map(|preset| preset.name)))]
    preset: Option<String>,
    /// Number of worker processes [default: cores - 1].
    #[arg(long, value_name = "N")]
    pub(super) workers: Option<u32>,
    /// Number of environments in each worker.
    #[arg(long, value_name = "E")]
    envs_per_worker: Option<u32>,
    /// Seed of all random streams.
    #[arg(long, value_name = "S", value_parser = integer())]
    seed: Option<i64>,
    /// Directory of your own environment modules; repeatable [default: the current directory or its
    /// `src`, if it has a pyproject.toml and the task's module].
    #[arg(long, value_name = "DIR")]
    python_path: Vec<PathBuf>,
    /// Argument of the environment or of gymnasium.make, such as reward_type=dense; repeatable. The
    /// value is a TOML value or a bare word.
    #[arg(long, value_name = "KEY=VALUE")]
    env_kwargs: Vec<String>,
    /// Configuration file, such as a run's config.toml.
    #[arg(long, value_name = "FILE")]
    pub(super) config: Option<PathBuf>,
    /// Set any configuration key; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl ConfiguredArgs {
    /// Returns true if no argument was given.
    pub(super) fn is_empty(&self) -> bool {
        let words = [&self.algo, &self.backend, &self.policy].into_iter().all(Option::is_none);
        let counts = [self.workers, self.envs_per_worker].into_iter().all(|count| count.is_none());
        let pairs = self.env_kwargs.is_empty() && self.set.is_empty();
        let lists = self.python_path.is_empty() && pairs;
        let seed = self.seed.is_none() && self.config.is_none();
        words && counts && lists && seed && self.preset.is_none()
    }

    /// Returns the preset that is used for `task` because the user chose none, unless that is
    /// `default`. A configuration file is complete without it.
    pub(super) fn automatic_preset(&self, task: &str) -> Option<&'static str> {
        let is_dense = |pair: &String| pair.split('=').map(str::trim).eq(["reward_type", "dense"]);
        let is_open = self.preset.is_none() && self.config.is_none();
        let is_open = is_open && !self.env_kwargs.iter().any(is_dense);
        Some(suitable_preset(task)).filter(|preset| is_open && *preset != PRESETS[0].name)
    }

    /// Returns true if an argument names folders of modules.
    pub(super) fn names_python_path(&self) -> bool {
        let key = "task.python_path";
        !self.python_path.is_empty() || self.set.iter().any(|pair| pair.trim().starts_with(key))
    }

    /// Returns the folder of the Python project in the current directory that has the module of
    /// `task`, unless an argument or a file names folders.
    pub(super) fn project_path(&self, task: &str) -> Option<PathBuf> {
        let is_open = !self.names_python_path() && self.config.is_none();
        let is_open = is_open && std::env::var_os("DMPRL_TASK__PYTHON_PATH").is_none();
        is_open.then(|| project_folder(Path::new("."), task)).flatten()
    }

    /// Collects all sources of the configuration of `task`; `more` are the command's own flags.
    pub(super) fn sources<'a>(
        &'a self,
        task: &'a str,
        more: impl IntoIterator<Item = Option<Flag>>,
    ) -> anyhow::Result<Sources<'a>> {
        let text = |value: &Option<String>| value.clone().map(Value::String);
        let count = |value: Option<u32>| value.map(|value| Value::Integer(value.into()));
        let found = self.project_path(task);
        let python_path = found.map_or_else(|| self.python_path.clone(), |folder| vec![folder]);
        let flags = [
            flag("--algo", "algorithm.name", text(&self.algo)),
            flag("--backend", "learner.backend", text(&self.backend)),
            flag("--policy", "policy.kind", text(&self.policy)),
            flag("--workers", "actors.workers", count(self.workers)),
            flag("--envs-per-worker", "actors.envs_per_worker", count(self.envs_per_worker)),
            flag("--seed", "run.seed", self.seed.map(Value::Integer)),
            flag("--python-path", "task.python_path", paths("--python-path", &python_path)?),
        ];
        Ok(Sources {
            task,
            preset: self
                .preset
                .as_deref()
                .or(self.automatic_preset(task))
                .unwrap_or(PRESETS[0].name),
            file: self.config.as_deref(),
            environment: environment()?,
            set: &self.set,
            env_kwargs: &self.env_kwargs,
            flags: flags.into_iter().chain(more).flatten().collect(),
        })
    }
}

/// Returns the folder in the Python project `project` from which the module of `task` is imported:
/// the project's own or its `src`.
pub(super) fn project_folder(project: &Path, task: &str) -> Option<PathBuf> {
    let (module, _) = task.split_once(':')?;
    let first = module.split('.').next().filter(|name| !name.is_empty())?;
    let has_module = |folder: &PathBuf| {
        folder.join(first).is_dir() || folder.join(first).with_extension("py").is_file()
    };
    let folders = [project.to_owned(), project.join("src")];
    folders.into_iter().find(has_module).filter(|_| project.join("pyproject.toml").is_file())
}

/// A flag that sets `key`, or `None` if it was not given.
pub(super) fn flag(flag: &'static str, key: &'static str, value: Option<Value>) -> Option<Flag> {
    value.map(|value| Flag { flag, key, value })
}

/// Parses a non-negative integer: TOML's integers are signed, with 64 bits.
pub(super) fn integer() -> RangedI64ValueParser<i64> {
    clap::value_parser!(i64).range(0..)
}

/// Checks that this program was built with the features that the configuration needs.
pub(super) fn check_build(config: &ExperimentConfig) -> anyhow::Result<()> {
    if config.learner.device == Device::Cuda && !cfg!(feature = "cuda") {
        return Err(wrong_use(
            "learner.device = \"cuda\": this build has no CUDA; on a machine with an NVIDIA GPU \
             and the CUDA toolkit, build with: cargo build --release --features cuda",
        ));
    }
    if config.bridge.listen.is_empty() {
        return Ok(());
    }
    dmprl_bridge::check_available().context("bridge.listen is set")
}

/// Makes the paths of the user's modules and demonstrations absolute: other processes have other
/// working directories, and a run can be resumed from any directory.
pub(super) fn make_absolute(config: &mut ExperimentConfig) -> anyhow::Result<()> {
    for path in &mut config.task.python_path {
        *path = absolute_folder(path)?;
    }
    for path in &mut config.demonstrations.files {
        *path = absolute_file(path, &config.task.name)?;
    }
    Ok(())
}

/// The value of a flag with file or folder names, or `None` if it was not given.
pub(super) fn paths(flag: &str, paths: &[PathBuf]) -> anyhow::Result<Option<Value>> {
    let texts = paths.iter().map(|path| {
        let text = path.to_str().map(|text| Value::String(text.to_owned()));
        text.ok_or_else(|| wrong_use(format!("{flag} {}: not UTF-8", path.display())))
    });
    let texts = texts.collect::<anyhow::Result<Vec<_>>>()?;
    Ok((!texts.is_empty()).then_some(Value::Array(texts)))
}

/// Resolves the path of an existing folder.
pub(super) fn absolute_folder(path: &str) -> anyhow::Result<String> {
    let absolute = std::fs::canonicalize(path)
        .map_err(|error| wrong_use(format!("python path {path}: {error}")))?;
    if !absolute.is_dir() {
        return Err(wrong_use(format!("python path {path} is not a directory")));
    }
    text(absolute)
}

fn absolute_file(path: &str, task: &str) -> anyhow::Result<String> {
    if is_foreign(path) {
        return Err(wrong_use(format!(
            "demonstrations {path}: expected a file here, because only `dmprl train` converts \
             other formats; convert it with: dmprl demos convert {path} demos.npz --task {task}"
        )));
    }
    let absolute = std::fs::canonicalize(path)
        .map_err(|error| wrong_use(format!("demonstrations {path}: {error}")))?;
    if !absolute.is_file() {
        return Err(wrong_use(format!("demonstrations {path}: not a file")));
    }
    text(absolute)
}

fn text(absolute: PathBuf) -> anyhow::Result<String> {
    let shown = absolute.display().to_string();
    absolute.into_os_string().into_string().map_err(|_| wrong_use(format!("{shown}: not UTF-8")))
}

/// Collects environment variables. Skips variables that are not UTF-8, but rejects those with the
/// prefix `DMPRL_`.
pub(super) fn environment() -> anyhow::Result<Vec<(String, String)>> {
    let mut texts = Vec::new();
    for (name, value) in std::env::vars_os() {
        let Ok(name) = name.into_string() else { continue };
        match value.into_string() {
            Ok(value) => texts.push((name, value)),
            Err(_) if name.starts_with("DMPRL_") => {
                return Err(wrong_use(format!("environment variable {name} is not UTF-8")));
            }
            Err(_) => {}
        }
    }
    Ok(texts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_of_a_python_project_is_found_by_the_module() {
        let project = tempfile::tempdir().unwrap();
        let at = |name: &str| project.path().join(name);
        let found = |task: &str| project_folder(project.path(), task);
        std::fs::write(at("arm.py"), "").unwrap();
        std::fs::create_dir_all(at("src/lab_envs")).unwrap();
        assert_eq!(found("arm:Arm-v0"), None, "no pyproject.toml");
        std::fs::write(at("pyproject.toml"), "").unwrap();
        assert_eq!(found("arm:Arm-v0"), Some(project.path().to_owned()));
        assert_eq!(found("lab_envs.arms:Arm"), Some(at("src")));
        for elsewhere in ["other:Arm-v0", "reacher", "Reacher-v5", ":Arm", ".x:Arm"] {
            assert_eq!(found(elsewhere), None, "{elsewhere}");
        }
    }
}
