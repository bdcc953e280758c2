//! The run that is struck: a real `dmprl train`, with keys that make much happen in little time.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context;
use rustix::process::Pid;

use super::TrialPlan;
use crate::launch::WholeRun;

/// Environment steps between two checkpoints, of which there is then about one a second.
pub(super) const CHECKPOINT_INTERVAL: u64 = 10_000;
/// Environment steps that the replay holds: soon full, so that its memory grows no more.
pub(super) const REPLAY_STEPS: u64 = 30_000;
/// Long beyond any trial.
const STEPS: &str = "1000000000000";
/// The longest pause before a restart: what is killed on purpose need not be spared.
const RESTART_PAUSE_MAX_MS: u32 = 100;

/// Small networks and few updates: the processes are tried, not what they learn. Outboxes so small
/// that workers soon forget what is acknowledged, and large enough that a learner's death finds
/// them with segments whose acknowledgement they have not heard, which come twice then.
fn keys() -> Vec<String> {
    let mut keys: Vec<String> = [
        "delivery.level=log",
        "delivery.unacknowledged_segments=256",
        "policy.hidden=[32,32]",
        "algorithm.critic_hidden=[32,32]",
        "algorithm.batch_size=32",
        "exploration.warm_up_steps=500",
        "pacing.updates_per_segment=0.5",
        "evaluation.episodes=2",
        "evaluation.interval_steps=50000",
        "metrics.interval_steps=5000",
        "actors.restarts_max=1000000",
        // The checker knows every worker there may be.
        "actors.joined_max=0",
        "supervision.learner_restarts_max=1000000",
    ]
    .map(str::to_owned)
    .into();
    keys.push(format!("checkpoint.interval_steps={CHECKPOINT_INTERVAL}"));
    keys.push(format!("replay.capacity_steps={REPLAY_STEPS}"));
    keys
}

/// A running `dmprl train`, and where it lies.
pub(super) struct Subject {
    train: WholeRun,
    pub(super) run: PathBuf,
    pub(super) journal: PathBuf,
}

impl Subject {
    /// Starts it in a folder.
    pub(super) fn start(plan: &TrialPlan, folder: &Path) -> anyhow::Result<Self> {
        let (run, journal) = (folder.join("run"), folder.join("journal"));
        std::fs::create_dir(&journal)
            .with_context(|| format!("cannot make {}", journal.display()))?;
        let mut command = Command::new(&plan.program);
        command.arg("train").arg(&plan.task).arg("--run-dir").arg(&run);
        command.arg("--journal").arg(&journal);
        command.args(["--no-progress", "--steps", STEPS]);
        command.args(["--restart-pause-max", &RESTART_PAUSE_MAX_MS.to_string()]);
        command.args(["--seed", &plan.seed.to_string(), "--workers", &plan.workers.to_string()]);
        for key in keys() {
            command.args(["--set", &key]);
        }
        let train = WholeRun::start(command, &folder.join("train.log"))?;
        Ok(Self { train, run, journal })
    }

    /// The supervisor.
    pub(super) fn pid(&self) -> anyhow::Result<Pid> {
        self.train.pid()
    }

    /// How it has ended by itself, if it has.
    pub(super) fn end(&mut self) -> anyhow::Result<Option<String>> {
        self.train.end()
    }

    /// Stops it as Ctrl-C does; returns what was wrong about its end.
    pub(super) fn stop(&mut self) -> anyhow::Result<Option<String>> {
        self.train.stop()
    }
}
