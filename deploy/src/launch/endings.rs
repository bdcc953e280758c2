//! How things end: a child's death, the run's regular end, an interrupt, a failure.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::{Error, anyhow};

use super::Process;
use super::child::describe;
use super::supervisor::{Phase, Supervisor};
use crate::control::Command;
use crate::terminal::shown;

/// Deaths of the evaluator without an answer in between before the run stops: a run that nobody
/// evaluates is not worth its electricity.
const EVALUATOR_RESTARTS_MAX: u32 = 3;
/// Two interrupts so close together count as one.
const INTERRUPT_GAP: Duration = Duration::from_millis(100);
/// Lines of a dead child's log that its error shows.
const LOG_LINES: usize = 15;
/// How far from the log's end they are looked for.
const LOG_TAIL_BYTES: u64 = 64 << 10;

impl Supervisor {
    /// Turns an error into the end of the run.
    pub(super) fn check(&mut self, result: anyhow::Result<()>) {
        if let Err(error) = result {
            self.fail(error);
        }
    }

    /// Ends the run because it cannot go on; the learner, if it lives, writes a checkpoint.
    fn fail(&mut self, error: Error) {
        if self.failure.is_some() || self.interrupts > 0 {
            self.display.message(&format!("while stopping: {error:#}"));
            return;
        }
        self.failure = Some(error);
        let learner = self.running(Process::Learner).is_some_and(|running| running.ready);
        self.stop(if learner { self.limits.drain } else { self.limits.stop });
    }

    /// Asks the learner to come to its end before its time.
    pub(super) fn drain(&mut self, reason: &str) {
        if self.phase == Phase::Training {
            self.display.message(&format!("{reason}: coming to an end"));
            self.phase = Phase::Draining { deadline: Instant::now() + self.limits.drain };
            self.send(Process::Learner, Command::Finish);
        }
    }

    /// The learner has written its last checkpoint; workers have nobody to step for.
    pub(super) fn on_finished(&mut self) {
        self.finished = true;
        if matches!(self.phase, Phase::Training | Phase::Draining { .. }) {
            self.phase = Phase::Finishing { deadline: Instant::now() + self.limits.drain };
            let actors = self.slots.iter_mut();
            for (_, slot) in actors.filter(|(process, _)| matches!(process, Process::Actor(_))) {
                slot.restart_at = None;
                // One that takes no command is killed when everything stops.
                let _ = slot.running.as_ref().map(|running| running.child.send(Command::Stop));
            }
        }
    }

    /// The regular end: the learner is gone, nothing is left to evaluate.
    pub(super) fn complete_if_done(&mut self) {
        let finishing = matches!(self.phase, Phase::Finishing { .. });
        let learner_gone = self.running(Process::Learner).is_none();
        if finishing && learner_gone && self.evaluations.outstanding() == 0 {
            self.stop(self.limits.stop);
        }
    }

    pub(super) fn on_interrupt(&mut self) {
        // `timeout` and some job schedulers send a signal to a process and to its group at once:
        // that is one wish, not two.
        let now = Instant::now();
        if self.interrupted_at.is_some_and(|at| now.duration_since(at) < INTERRUPT_GAP) {
            return;
        }
        self.interrupted_at = Some(now);
        self.interrupts += 1;
        match self.interrupts {
            1 => {
                let what =
                    if self.finished { "skipping evaluations" } else { "writing a checkpoint" };
                self.display.message(&format!("interrupted: {what} (once more: stop at once)"));
                self.stop(self.limits.stop);
            }
            2 => self.kill_all("interrupted twice"),
            _ => {}
        }
    }

    /// Asks every child to end within `limit`.
    fn stop(&mut self, limit: Duration) {
        let mut deadline = Instant::now() + limit;
        let mut killed = false;
        if let Phase::Stopping { deadline: before, killed: already } = self.phase {
            // Already asked; an interrupt makes it more urgent, nothing makes it less.
            deadline = deadline.min(before);
            killed = already;
        } else {
            self.evaluations.clear();
            self.slots.values_mut().for_each(|slot| slot.restart_at = None);
            for (_, running) in self.all_running() {
                // One that takes no command is killed at the deadline.
                let _ = running.child.send(Command::Stop);
            }
        }
        self.phase = Phase::Stopping { deadline, killed };
    }

    /// SIGKILL to whatever still runs.
    pub(super) fn kill_all(&mut self, reason: &str) {
        let names: Vec<String> =
            self.all_running().map(|(process, _)| process.to_string()).collect();
        if !names.is_empty() {
            self.display.message(&format!("{reason}: killed {}", names.join(", ")));
        }
        self.all_running().for_each(|(_, running)| running.child.kill());
        self.phase = Phase::Stopping { deadline: Instant::now() + self.limits.kill, killed: true };
    }

    /// Not even SIGKILL helped, which only a fault of kernel or device explains.
    pub(super) fn abandon(&mut self) {
        let names: Vec<String> =
            self.all_running().map(|(process, _)| process.to_string()).collect();
        let limit = self.limits.kill;
        self.failure = Some(anyhow!("{} did not end {limit:?} after SIGKILL", names.join(", ")));
        self.abandoned = true;
    }

    pub(super) fn on_exit(&mut self, process: Process, status: ExitStatus) -> anyhow::Result<()> {
        let was_ready = self
            .slots
            .get_mut(&process)
            .and_then(|slot| slot.running.take())
            .is_some_and(|running| running.ready);
        if let Phase::Stopping { killed, .. } = self.phase {
            if process == Process::Learner && was_ready && !self.finished {
                let cause = if killed { String::new() } else { format!(": {}", describe(status)) };
                let what = "learner ended without its last checkpoint";
                self.display.message(&format!("{what}{cause}"));
            }
            return Ok(());
        }
        match process {
            Process::Learner if self.finished => {
                if !status.success() {
                    self.display.message(&format!("learner ended with {}", describe(status)));
                }
                self.complete_if_done();
                Ok(())
            }
            Process::Learner => self.on_learner_death(status),
            Process::Evaluator => self.on_evaluator_death(status),
            Process::Actor(_) if self.phase == Phase::Training => {
                self.on_actor_death(process, status)
            }
            Process::Actor(_) => Ok(()),
        }
    }

    fn on_evaluator_death(&mut self, status: ExitStatus) -> anyhow::Result<()> {
        self.evaluator_ends = false;
        self.evaluations.send_again();
        if matches!(self.phase, Phase::Finishing { .. }) && self.evaluations.outstanding() == 0 {
            self.complete_if_done();
            return Ok(());
        }
        if self.restart(Process::Evaluator, status, EVALUATOR_RESTARTS_MAX) {
            return Ok(());
        }
        Err(self.death(Process::Evaluator, status, self.resume_advice()))
    }

    fn on_actor_death(&mut self, process: Process, status: ExitStatus) -> anyhow::Result<()> {
        // Before any worker has shown that the environment works, one that gives up by itself
        // has a reason that another start does not mend.
        if self.spec.is_none() && status.code().is_some() {
            return Err(self.death(process, status, String::new()));
        }
        if self.restart(process, status, self.config.actors.restarts_max) {
            return Ok(());
        }
        let left = self.slots.iter().filter(|(process, slot)| {
            let lives = slot.running.is_some() || slot.restart_at.is_some();
            matches!(process, Process::Actor(_)) && lives
        });
        let left = left.count();
        if left == 0 {
            return Err(self
                .death(process, status, self.resume_advice())
                .context("no worker is left: each has died more often than actors.restarts_max"));
        }
        self.display.message(&format!(
            "{process} died again ({}): giving up on it after {} restarts, going on with {left} \
             of {} workers; log: {}",
            describe(status),
            self.config.actors.restarts_max,
            self.config.actors.workers,
            shown(&self.log_path(process))
        ));
        Ok(())
    }

    /// Schedules a restart; false when the process has had all of them.
    pub(super) fn restart(
        &mut self,
        process: Process,
        status: ExitStatus,
        restarts_max: u32,
    ) -> bool {
        let log = shown(&self.log_path(process));
        let slot = self.slots.entry(process).or_default();
        if slot.restarts >= restarts_max {
            return false;
        }
        let wait = self.limits.back_off(slot.restarts);
        slot.restarts += 1;
        slot.restart_at = Some(Instant::now() + wait);
        self.display.message(&format!(
            "{process} died ({}): restart {} of {restarts_max} in {:.1} s; log: {log}",
            describe(status),
            slot.restarts,
            wait.as_secs_f64(),
        ));
        true
    }

    pub(super) fn log_path(&self, process: Process) -> std::path::PathBuf {
        self.launcher.run.log_path(&process.to_string())
    }

    /// Nothing where a resume would only begin again and meet the same end. A learner that lives
    /// writes a checkpoint when the run stops.
    pub(super) fn resume_advice(&self) -> String {
        let learner = self.running(Process::Learner).is_some_and(|running| running.ready);
        if !learner && !self.launcher.run.has_checkpoint().unwrap_or(false) {
            return String::new();
        }
        format!(
            "\n  go on from the last checkpoint: dmprl resume {}",
            shown(self.launcher.run.path())
        )
    }

    pub(super) fn death(&self, process: Process, status: ExitStatus, advice: String) -> Error {
        let log = self.log_path(process);
        anyhow!("{process} died: {}{}{advice}", describe(status), log_tail(&log))
    }
}

/// The log's last lines below a heading that names it, ready to follow an error.
pub(super) fn log_tail(path: &Path) -> String {
    format!("\n  last lines of {}:\n{}", shown(path), last_lines(path))
}

/// A log's last lines, indented.
pub(crate) fn last_lines(path: &Path) -> String {
    let read = || -> std::io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let len = file.metadata()?.len();
        file.seek(SeekFrom::Start(len.saturating_sub(LOG_TAIL_BYTES)))?;
        let mut tail = Vec::new();
        file.take(LOG_TAIL_BYTES).read_to_end(&mut tail)?;
        Ok(tail)
    };
    let tail = read().unwrap_or_default();
    let text = String::from_utf8_lossy(&tail);
    let lines: Vec<&str> = text.lines().collect();
    let last = lines[lines.len().saturating_sub(LOG_LINES)..].iter().map(|line| {
        // What an environment prints must not steer the user's terminal.
        let plain = line.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
        format!("    {}", plain.collect::<String>())
    });
    last.collect::<Vec<_>>().join("\n")
}
