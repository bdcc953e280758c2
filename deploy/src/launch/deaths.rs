//! What becomes of a child that has ended: another start, or giving up on it.
//!
//! A child that dies soon after each start is a crash loop and is given up; one that did its work
//! for [`TimeLimits::proven`](super::TimeLimits::proven) before has all its restarts again, and the
//! shortest pause, or a run of weeks would lose its workers one death a day.

use std::fmt::{self, Display, Formatter};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::ExitStatus;
use std::time::Instant;

use anyhow::{Error, anyhow};

use super::Process;
use super::child::describe;
use super::launcher::INCARNATIONS_PER_SESSION;
use super::supervisor::{Phase, Running, Slot, Supervisor};
use crate::terminal::shown;

/// Deaths of the evaluator without an answer in between before the run stops: a run that nobody
/// evaluates is not worth its electricity.
const EVALUATOR_RESTARTS_MAX: u32 = 3;
/// Lines of a dead child's log that its error shows.
const LOG_LINES: usize = 15;
/// How far from the log's end they are looked for.
const LOG_TAIL_BYTES: u64 = 64 << 10;

/// How a child ended, for the user: by itself, or why the supervisor has killed it.
#[derive(Debug)]
pub(super) struct Death {
    verb: &'static str,
    cause: String,
}

impl Death {
    pub(super) fn of(status: ExitStatus) -> Self {
        Self { verb: "died", cause: describe(status) }
    }

    /// It gave no sign of life.
    pub(super) fn hung(cause: String) -> Self {
        Self { verb: "hung", cause }
    }

    /// It had joined and is of no use.
    pub(super) fn sent_away(cause: String) -> Self {
        Self { verb: "was sent away", cause }
    }

    /// It did not come to an end with what it was to do.
    pub(super) fn too_slow(cause: String) -> Self {
        Self { verb: "was killed", cause }
    }
}

impl Display for Death {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} ({})", self.verb, self.cause)
    }
}

impl Supervisor<'_> {
    pub(super) fn on_exit(&mut self, process: Process, status: ExitStatus) -> anyhow::Result<()> {
        let ended = self.slots.get_mut(&process).and_then(|slot| slot.running.take());
        let was_ready = ended.as_ref().is_some_and(|running| running.ready);
        if let Phase::Stopping { killed, .. } = self.phase {
            if process == Process::Learner && was_ready && !self.finished {
                let cause = if killed { String::new() } else { format!(": {}", describe(status)) };
                let what = "learner ended without its last checkpoint";
                self.message(&format!("{what}{cause}"));
            }
            if self.hub() == Process::Relay {
                // It stays until the last worker is gone, whose last segment may come yet.
                self.tell_learner_of_counts();
            }
            return Ok(());
        }
        if ended.as_ref().is_some_and(|running| self.is_proven(process, running)) {
            self.forgive(process);
        }
        let killed_for = ended.and_then(|running| running.killed_for);
        let death = killed_for.unwrap_or_else(|| Death::of(status));
        match process {
            Process::Learner | Process::Relay if self.finished => {
                if !status.success() {
                    self.message(&format!("{process} ended with {}", describe(status)));
                }
                self.complete_if_done();
                Ok(())
            }
            Process::Learner | Process::Relay => self.on_learner_death(status, &death),
            // An address that is not free, a file that is not there: no start mends that.
            Process::Gateway if !was_ready && status.code().is_some() => {
                Err(self.death(process, &death, String::new()))
            }
            Process::Gateway => {
                self.on_gateway_death(&death);
                Ok(())
            }
            Process::Evaluator => self.on_evaluator_death(&death),
            Process::Actor(_) if self.phase == Phase::Training => {
                self.on_actor_death(process, status, &death)
            }
            Process::Actor(_) => Ok(()),
        }
    }

    /// Whether a child did its work for long: a worker delivered segments; a learner lived, and
    /// wrote a checkpoint, without which its successor would have to do all of it again. For the
    /// evaluator each answer counts.
    fn is_proven(&self, process: Process, running: &Running) -> bool {
        let Some((first, last)) = running.worked else { return false };
        match process {
            Process::Actor(_) => last.duration_since(first) >= self.limits.proven,
            Process::Learner | Process::Relay | Process::Gateway => {
                running.spawned.elapsed() >= self.limits.proven
            }
            Process::Evaluator => false,
        }
    }

    /// Gives a child all its restarts again, and the shortest pause before the next.
    pub(super) fn forgive(&mut self, process: Process) {
        if let Some(slot) = self.slots.get_mut(&process) {
            slot.restarts = 0;
        }
    }

    /// Notes that a child has told of work.
    pub(super) fn worked(&mut self, process: Process) {
        let slot = self.slots.get_mut(&process);
        if let Some(running) = slot.and_then(|slot| slot.running.as_mut()) {
            let now = Instant::now();
            running.worked = Some((running.worked.map_or(now, |(first, _)| first), now));
        }
    }

    /// A run that other hosts have left goes on with its own workers.
    fn on_gateway_death(&mut self, death: &Death) {
        self.hosts.clear();
        let restarts_max = self.config.supervision.learner_restarts_max;
        if self.phase == Phase::Training && !self.restart(Process::Gateway, death, restarts_max) {
            self.message(&format!(
                "gateway {death}: giving up on it after {restarts_max} restarts; the run goes on \
                 without other hosts{}",
                log_tail(&self.log_path(Process::Gateway))
            ));
        }
    }

    fn on_evaluator_death(&mut self, death: &Death) -> anyhow::Result<()> {
        self.evaluator_ends = false;
        self.evaluations.send_again();
        if matches!(self.phase, Phase::Finishing { .. }) && self.evaluations.outstanding() == 0 {
            self.complete_if_done();
            return Ok(());
        }
        if self.restart(Process::Evaluator, death, EVALUATOR_RESTARTS_MAX) {
            return Ok(());
        }
        Err(self.death(Process::Evaluator, death, self.resume_advice()))
    }

    fn on_actor_death(
        &mut self,
        process: Process,
        status: ExitStatus,
        death: &Death,
    ) -> anyhow::Result<()> {
        // Before any worker has shown that the environment works, one that gives up by itself
        // has a reason that another start does not mend.
        if self.spec.is_none() && status.code().is_some() {
            return Err(self.death(process, death, String::new()));
        }
        if self.restart(process, death, self.config.actors.restarts_max) {
            return Ok(());
        }
        let left = self.workers_left();
        if left == 0 {
            return Err(self
                .death(process, death, self.resume_advice())
                .context("no worker is left: each has died more often than actors.restarts_max"));
        }
        let restarts = self.slots.get(&process).map_or(0, |slot| slot.restarts);
        self.message(&format!(
            "{process} {death} again: giving up on it after {restarts} restarts, going on with \
             {left} of {} workers{}",
            self.config.actors.workers + self.joined(),
            log_tail(&self.log_path(process))
        ));
        Ok(())
    }

    /// Workers that live or will again.
    pub(super) fn workers_left(&self) -> usize {
        let lives = |(process, slot): &(&Process, &Slot)| {
            let lives = slot.running.is_some() || slot.restart_at.is_some();
            matches!(process, Process::Actor(_)) && lives
        };
        self.slots.iter().filter(lives).count()
    }

    /// Schedules a restart; false when the process has had all of them.
    pub(super) fn restart(&mut self, process: Process, death: &Death, restarts_max: u32) -> bool {
        let log = shown(&self.log_path(process));
        let slot = self.slots.entry(process).or_default();
        // No run comes so far but one that restarts without an end.
        let numbered = slot.starts < INCARNATIONS_PER_SESSION;
        if slot.restarts >= restarts_max || !numbered {
            return false;
        }
        let wait = self.limits.back_off(slot.restarts);
        slot.restarts += 1;
        slot.restart_at = Some(Instant::now() + wait);
        let restarts = slot.restarts;
        self.worker_restarts += u64::from(matches!(process, Process::Actor(_)));
        self.message(&format!(
            "{process} {death}: restart {restarts} of {restarts_max} in {:.1} s; log: {log}",
            wait.as_secs_f64(),
        ));
        true
    }

    /// Where to read more of a process, as part of a sentence.
    pub(super) fn log_of(&self, process: Process) -> String {
        match self.is_joined(process) {
            true => "its own terminal has more".to_owned(),
            false => format!("log: {}", shown(&self.log_path(process))),
        }
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

    pub(super) fn death(&self, process: Process, death: &Death, advice: String) -> Error {
        let log = self.log_path(process);
        let Death { verb, cause } = death;
        anyhow!("{process} {verb}: {cause}{}{advice}", log_tail(&log))
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
