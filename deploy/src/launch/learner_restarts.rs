//! A learner that was killed or crashed, and its successor.

use std::process::ExitStatus;
use std::time::Instant;

use super::Process;
use super::deaths::Death;
use super::supervisor::Supervisor;

/// Exit status of a program that panicked.
const PANIC_STATUS: i32 = 101;

impl Supervisor<'_> {
    /// Starts another after a pause: from the newest usable checkpoint, or else from the beginning.
    /// Workers wait meanwhile and keep what they have sent. A learner that ended by itself gave a
    /// reason that another start does not mend.
    pub(super) fn on_learner_death(
        &mut self,
        status: ExitStatus,
        death: &Death,
    ) -> anyhow::Result<()> {
        let crashed = status.code().is_none_or(|code| code == PANIC_STATUS);
        let restarts_max = self.config.supervision.learner_restarts_max;
        let goes_on = crashed && !self.is_one_process();
        if !goes_on || !self.restart(self.hub(), death, restarts_max) {
            return Err(self.death(self.hub(), death, self.resume_advice()));
        }
        self.learner_restarts += 1;
        self.learner_died.get_or_insert_with(Instant::now);
        self.learner_ready = false;
        self.give_up_evaluations();
        Ok(())
    }

    /// The successor cuts the curve back to its checkpoint and asks anew for what is missing there.
    /// So an evaluation that goes on must not add its row behind the cut: it ends with its process,
    /// before the successor starts.
    fn give_up_evaluations(&mut self) {
        let in_flight = self.evaluations.deadline().is_some();
        self.evaluations.clear();
        let Some(slot) = self.slots.get_mut(&Process::Evaluator) else { return };
        if let Some(running) = slot.running.as_mut().filter(|_| in_flight) {
            running.kill_for(Death::too_slow("its learner died".to_owned()));
            // Not a death of its own.
            slot.restarts = 0;
            self.evaluator_ends = true;
        }
    }

    /// Whether a child whose pause is over may start.
    pub(super) fn may_start(&self, process: Process) -> bool {
        process != Process::Learner || !self.evaluator_ends
    }

    /// What the successor of a dead learner starts from.
    pub(super) fn go_back(&mut self) -> anyhow::Result<()> {
        if self.hub() == Process::Relay {
            return Ok(());
        }
        self.launcher.learner_restarts = self.earlier.learner_restarts + self.learner_restarts;
        self.launcher.resume = self.launcher.run.has_checkpoint()?;
        if !self.launcher.resume {
            self.launcher.run.begin_again()?;
        }
        Ok(())
    }
}
