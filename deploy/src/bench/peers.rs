//! What the workers are compared with: processes of `dmprl.bench_rollout`, one for each worker.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use serde::Deserialize;

use super::child::LineChild;
use super::figures::Round;
use super::watch::Watch;
use crate::run_directory::RunDirectory;

/// From a start to the first line: many processes may start at once, with many environments each.
const READY: Duration = Duration::from_secs(300);
/// Beyond what was asked for, a measurement may take so much longer.
const MEASURE_SLACK: Duration = Duration::from_secs(60);

/// One way to do the workers' work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PeerKind {
    /// `mujoco.batch` alone, as it is imported, on the model file that Gymnasium ships.
    Ceiling,
    /// `mujoco.batch` alone, on the worker's own model and process settings.
    Physics,
    /// A plain Gymnasium loop with the policy in NumPy.
    Gymnasium,
    /// EnvPool with the policy in NumPy.
    EnvPool,
    /// A loop over panda-gym's environments with random actions.
    PandaGym,
}

/// Name of [`PeerKind::PandaGym`].
pub(super) const PANDA_GYM: &str = "panda_gym";
/// The tasks that panda-gym has too; `dmprl.bench_peers` knows what it calls them.
const PANDA_GYM_TASKS: [&str; 2] = ["dmprl/PandaReach-v0", "dmprl/PandaReachJoints-v0"];

/// Whether panda-gym has an environment to compare this one with.
pub(super) fn is_in_panda_gym(env_id: &str) -> bool {
    PANDA_GYM_TASKS.contains(&env_id)
}

impl PeerKind {
    /// In the order of a round. The worker comes after its bounds, so that a machine that drifts
    /// does so for both.
    pub(super) const ALL: [Self; 5] =
        [Self::PandaGym, Self::EnvPool, Self::Gymnasium, Self::Ceiling, Self::Physics];

    /// As `dmprl.bench_rollout` calls it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Ceiling => "ceiling",
            Self::Physics => "physics",
            Self::Gymnasium => "gymnasium",
            Self::EnvPool => "envpool",
            Self::PandaGym => PANDA_GYM,
        }
    }

    /// Whether it runs in the interpreter of the user's choice: it is none of this project's
    /// requirements, and has some that do not go with them.
    pub(super) fn is_foreign(self) -> bool {
        matches!(self, Self::EnvPool | Self::PandaGym)
    }
}

/// What every peer's command line is made of.
pub(super) struct PeerStage<'a> {
    /// Where logs go.
    pub(super) run: &'a RunDirectory,
    /// The folder with the package `dmprl`.
    pub(super) package_path: PathBuf,
    /// What [`super::NumpyPlan`] has written.
    pub(super) plan: PathBuf,
    /// Processes of each peer.
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
        stage: &PeerStage<'_>,
    ) -> anyhow::Result<Self> {
        let start = |index: usize| {
            let name = format!("{}-{index}", kind.name());
            let path = stage.run.log_path(&name);
            let log =
                File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
            let mut command = Command::new(python);
            command
                .args(["-m", "dmprl.bench_rollout", kind.name(), "--plan"])
                .arg(&stage.plan)
                .args(["--index", &index.to_string()])
                // `-m` puts the working directory before everything else: one without modules.
                .current_dir(stage.run.path())
                .env("PYTHONPATH", &stage.package_path)
                .stderr(log);
            // As in the worker: one thread of linear algebra in each process.
            for name in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"] {
                command.env(name, "1");
            }
            LineChild::start(name, command, &path)
        };
        let children = (0..stage.workers).map(start).collect::<anyhow::Result<_>>()?;
        Ok(Self { kind, children })
    }

    /// Waits until every process is ready, and returns what it measures; an error inside says why
    /// it is not to be had here.
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

    /// What all processes together make in so much time.
    pub(super) fn measure(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<Round> {
        let seconds = duration.as_secs_f64();
        for child in &mut self.children {
            child.say(&format!("run {seconds}"))?;
        }
        let (mut steps_per_s, mut cores) = (0.0, 0.0);
        for child in &mut self.children {
            let line = child.next(watch, duration + MEASURE_SLACK, "the measurement")?;
            let Ok(Measured { steps, seconds, cpu_s }) = serde_json::from_str(&line) else {
                return Err(child.no_answer(&line));
            };
            ensure!(
                steps > 0 && seconds > 0.0,
                "{}: {steps} steps in {seconds} s, expected some",
                child.name()
            );
            steps_per_s += steps as f64 / seconds;
            cores += cpu_s / seconds;
        }
        Ok(Round { steps_per_s, cores: Some(cores) })
    }
}
