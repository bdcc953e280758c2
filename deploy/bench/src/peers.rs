//! Peers of the workers: processes of `dmprl.bench_rollout`, one for each worker.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use dmprl_run::RunDirectory;
use dmprl_run::Watch;
use serde::Deserialize;

use super::child::LineChild;
use super::round::Round;

/// Time limit until a process is ready. Many may start at once, each with many environments.
const READY: Duration = Duration::from_secs(300);
/// Time beyond a measurement's duration until it times out.
const MEASURE_SLACK: Duration = Duration::from_secs(60);

/// An alternative to the workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PeerKind {
    /// `mujoco.batch` alone, as imported, on the model file that Gymnasium ships.
    Mujoco,
    /// `mujoco.batch` alone, with the worker's own model and process settings. No worker is faster.
    Ceiling,
    /// A plain Gymnasium loop with the policy in NumPy.
    Gymnasium,
    /// EnvPool with the policy in NumPy.
    EnvPool,
    /// A loop over panda-gym's environments with random actions.
    PandaGym,
}

/// Name of [`PeerKind::PandaGym`].
pub(super) const PANDA_GYM: &str = "panda_gym";
/// Start of the ids of tasks that panda-gym has too. `dmprl.bench_peers` maps them to its names.
const PANDA_GYM_TASKS: &str = "dmprl/Panda";

/// Returns true if panda-gym has an equivalent of this environment.
pub(super) fn is_in_panda_gym(env_id: &str) -> bool {
    env_id.starts_with(PANDA_GYM_TASKS)
}

impl PeerKind {
    /// All peers, in the order of a round. The workers' upper bounds (`Mujoco`, `Ceiling`) come
    /// last, right before the workers, so that drift of the machine's speed affects both alike.
    pub(super) const ALL: [Self; 5] =
        [Self::PandaGym, Self::EnvPool, Self::Gymnasium, Self::Mujoco, Self::Ceiling];

    /// Name of the peer in `dmprl.bench_rollout`.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Mujoco => "mujoco",
            Self::Ceiling => "ceiling",
            Self::Gymnasium => "gymnasium",
            Self::EnvPool => "envpool",
            Self::PandaGym => PANDA_GYM,
        }
    }

    /// Returns true if the peer needs an interpreter given by the user, because its dependencies
    /// conflict with those of this project.
    pub(super) fn is_foreign(self) -> bool {
        matches!(self, Self::EnvPool | Self::PandaGym)
    }
}

/// The parts of the command line that all peers share.
pub(super) struct PeerSetup<'a> {
    /// Run directory for logs.
    pub(super) run: &'a RunDirectory,
    /// Folder with the package `dmprl`.
    pub(super) package_path: PathBuf,
    /// File written by [`super::NumpyPlan`].
    pub(super) plan: PathBuf,
    /// Processes per peer.
    pub(super) workers: usize,
}

/// The processes of one peer.
pub(super) struct Peer {
    pub(super) kind: PeerKind,
    children: Vec<LineChild>,
}

#[derive(Debug, Deserialize)]
struct Measured {
    steps: u64,
    seconds: f64,
    cpu_s: f64,
}

impl Peer {
    /// Starts the processes without waiting for them.
    pub(super) fn start(
        kind: PeerKind,
        python: &Path,
        setup: &PeerSetup<'_>,
    ) -> anyhow::Result<Self> {
        let start = |index: usize| {
            let name = format!("{}-{index}", kind.name());
            let path = setup.run.log_path(&name);
            let log =
                File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
            let mut command = Command::new(python);
            command
                .args(["-m", "dmprl.bench_rollout", kind.name(), "--plan"])
                .arg(&setup.plan)
                .args(["--index", &index.to_string()])
                // `-m` puts the working directory first on the module path, so it must have none.
                .current_dir(setup.run.path())
                .env("PYTHONPATH", &setup.package_path)
                .stderr(log);
            // One thread for linear algebra in each process, as in the worker.
            for name in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"] {
                command.env(name, "1");
            }
            LineChild::start(name, command, &path)
        };
        let children = (0..setup.workers).map(start).collect::<anyhow::Result<_>>()?;
        Ok(Self { kind, children })
    }

    /// Waits until every process is ready. Returns a description, or the reason why the peer is
    /// unavailable.
    pub(super) fn ready(&mut self, watch: &Watch) -> anyhow::Result<Result<String, String>> {
        let mut about = String::new();
        for child in &mut self.children {
            match child.greeting(watch, READY)? {
                Ok(text) => about = text,
                Err(why) => return Ok(Err(why)),
            }
        }
        Ok(Ok(about))
    }

    /// Measures the rate of all processes together.
    pub(super) fn measure(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<Round> {
        let seconds = duration.as_secs_f64();
        for child in &mut self.children {
            child.send_line(&format!("run {seconds}"))?;
        }
        let (mut steps_per_s, mut cores) = (0.0, 0.0);
        for child in &mut self.children {
            let line = child.next_line(watch, duration + MEASURE_SLACK, "the measurement")?;
            let Ok(Measured { steps, seconds, cpu_s }) = serde_json::from_str(&line) else {
                return Err(child.unexpected_line(&line));
            };
            ensure!(
                steps > 0 && seconds > 0.0,
                "{}: {steps} steps in {seconds} s, expected at least one",
                child.name()
            );
            steps_per_s += steps as f64 / seconds;
            cores += cpu_s / seconds;
        }
        Ok(Round { steps_per_s, cores: Some(cores) })
    }
}
