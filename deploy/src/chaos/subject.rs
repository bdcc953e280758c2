//! The run that is struck: a real `dmprl train`, with keys that make much happen in little time.

use std::fs::File;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use rustix::process::{Pid, Signal, kill_process};

use super::TrialPlan;
use crate::launch::{describe, last_lines};

/// Environment steps between two checkpoints, of which there is then about one a second.
pub(super) const CHECKPOINT_INTERVAL: u64 = 10_000;
/// Environment steps that the replay holds: soon full, so that its memory grows no more.
pub(super) const REPLAY_STEPS: u64 = 30_000;
/// Long beyond any trial.
const STEPS: &str = "1000000000000";
/// The longest pause before a restart: what is killed on purpose need not be spared.
const RESTART_PAUSE_MAX_MS: u32 = 100;
/// From SIGINT to the end; the supervisor has limits of its own.
const END: Duration = Duration::from_secs(90);
/// Between two looks for the end.
const LOOK: Duration = Duration::from_millis(10);

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

/// A running `dmprl train`. Dropped, it is killed, and its children end by themselves.
pub(super) struct Subject {
    child: Child,
    log: PathBuf,
    pub(super) run: PathBuf,
    pub(super) journal: PathBuf,
}

impl Subject {
    /// Starts it in a folder.
    pub(super) fn start(plan: &TrialPlan, folder: &Path) -> anyhow::Result<Self> {
        let (run, journal) = (folder.join("run"), folder.join("journal"));
        std::fs::create_dir(&journal)
            .with_context(|| format!("cannot make {}", journal.display()))?;
        let log = folder.join("train.log");
        let file = File::create(&log).with_context(|| format!("cannot make {}", log.display()))?;
        let mut command = Command::new(&plan.program);
        command.arg("train").arg(&plan.task).arg("--run-dir").arg(&run);
        command.arg("--journal").arg(&journal);
        command.args(["--no-progress", "--steps", STEPS]);
        command.args(["--restart-pause-max", &RESTART_PAUSE_MAX_MS.to_string()]);
        command.args(["--seed", &plan.seed.to_string(), "--workers", &plan.workers.to_string()]);
        for key in keys() {
            command.args(["--set", &key]);
        }
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("DMPRL_") {
                command.env_remove(name);
            }
        }
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(file);
        // A session of its own: Ctrl-C is for us, and the kernel must not wake its stopped members.
        // SAFETY: both are system calls, allocate nothing and touch no lock.
        unsafe {
            command.pre_exec(|| {
                rustix::process::setsid()?;
                // When this program is killed the run comes to its end by itself.
                rustix::process::set_parent_process_death_signal(Some(Signal::INT))?;
                Ok(())
            });
        }
        let child = command.spawn().context("cannot start dmprl train")?;
        Ok(Self { child, log, run, journal })
    }

    /// The supervisor.
    pub(super) fn pid(&self) -> anyhow::Result<Pid> {
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw);
        pid.context("a child without an id")
    }

    /// How it has ended by itself, if it has.
    pub(super) fn end(&mut self) -> anyhow::Result<Option<String>> {
        let status = self.child.try_wait().context("cannot wait for dmprl train")?;
        Ok(status.map(|status| self.told(status)))
    }

    fn told(&self, status: ExitStatus) -> String {
        let (how, lines) = (describe(status), last_lines(&self.log));
        format!("{how}; the last lines of {}:\n{lines}", self.log.display())
    }

    /// Stops it as Ctrl-C does; returns what was wrong about its end.
    pub(super) fn stop(&mut self) -> anyhow::Result<Option<String>> {
        let pid = self.pid()?;
        kill_process(pid, Signal::INT).context("cannot interrupt dmprl train")?;
        let deadline = Instant::now() + END;
        loop {
            if let Some(status) = self.child.try_wait().context("cannot wait for dmprl train")? {
                let regular = status.code() == Some(130);
                return Ok((!regular).then(|| self.told(status)));
            }
            if Instant::now() >= deadline {
                self.child.kill().context("cannot kill dmprl train")?;
                let status = self.child.wait().context("cannot wait for dmprl train")?;
                return Ok(Some(format!("not within {END:?} of SIGINT; {}", self.told(status))));
            }
            std::thread::sleep(LOOK);
        }
    }
}

impl Drop for Subject {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
