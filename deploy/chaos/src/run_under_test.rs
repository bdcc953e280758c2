//! The run under test: a real `dmprl train`, configured to produce many events in a short time.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context;
use dmprl_supervisor::WholeRun;
use rustix::process::Pid;

use super::TrialPlan;

/// Environment steps between two checkpoints, which results in about one per second.
pub(super) const CHECKPOINT_INTERVAL: u64 = 10_000;
/// Capacity of the replay in environment steps. It is small, so that its memory soon stops growing.
pub(super) const REPLAY_STEPS: u64 = 30_000;
/// More steps than any trial reaches.
const STEPS: &str = "1000000000000";
/// Maximum back-off before a restart. It is short, because the processes are killed on purpose.
const RESTART_PAUSE_MAX_MS: u32 = 100;

/// Returns the run's configuration. Networks are small and updates few, because the trial tests
/// processes, not learning. The outboxes are small enough that workers soon drop acknowledged
/// segments, but large enough that workers retransmit some segments after a learner's death.
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
        // The checker must know every worker in advance.
        "actors.joined_max=0",
        "supervision.learner_restarts_max=1000000",
    ]
    .map(str::to_owned)
    .into();
    keys.push(format!("checkpoint.interval_steps={CHECKPOINT_INTERVAL}"));
    keys.push(format!("replay.capacity_steps={REPLAY_STEPS}"));
    keys
}

/// A running `dmprl train` and its paths.
pub(super) struct RunUnderTest {
    train: WholeRun,
    pub(super) run: PathBuf,
    pub(super) journal: PathBuf,
}

impl RunUnderTest {
    /// Starts the run in a folder.
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

    /// Returns the process id of the supervisor.
    pub(super) fn pid(&self) -> anyhow::Result<Pid> {
        self.train.pid()
    }

    /// Returns how the run ended if it has ended by itself.
    pub(super) fn end(&mut self) -> anyhow::Result<Option<String>> {
        self.train.end()
    }

    /// Stops the run like Ctrl-C. Returns a description of the error if it did not end cleanly.
    pub(super) fn stop(&mut self) -> anyhow::Result<Option<String>> {
        self.train.stop()
    }
}
