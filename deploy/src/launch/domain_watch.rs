//! Looks whether the run's shared memory is still there.
//!
//! Somebody, or a cleaner of temporary files, may remove its directory under a run. What is mapped
//! stays: segments go on arriving, and nothing is torn. But no process can join any more, so the
//! next death would be the last; and the learner could not clean up. So the run ends in time, with
//! a checkpoint to resume from.

use std::time::{Duration, Instant};

use anyhow::ensure;

use super::supervisor::{Phase, Supervisor};
use crate::terminal::shown;

/// The directory is looked for at least so often, and whenever something is heard: one `stat`.
const DOMAIN_LOOK: Duration = Duration::from_secs(1);

impl Supervisor<'_> {
    /// When to look again, while there is anything to look for.
    pub(super) fn next_look_at_domain(&self, now: Instant) -> Option<Instant> {
        self.launcher.domain.as_ref().filter(|_| self.needs_domain()).map(|_| now + DOMAIN_LOOK)
    }

    fn needs_domain(&self) -> bool {
        matches!(self.phase, Phase::Training | Phase::Draining { .. })
    }

    /// Ends the run if the directory is gone.
    pub(super) fn check_domain(&self) -> anyhow::Result<()> {
        let Some(domain) = self.launcher.domain.as_ref().filter(|_| self.needs_domain()) else {
            return Ok(());
        };
        ensure!(
            domain.is_dir(),
            "the run's shared memory is gone: {} was removed under it; nothing may clear /dev/shm \
             while a run goes on{}",
            shown(domain),
            self.resume_advice()
        );
        Ok(())
    }
}
