//! Decides when the learner cleans up after dead processes.
//!
//! To find dead processes, iceoryx2 reads several files per process, and three times as many for a
//! worker. With 256 workers this takes 0.1 s, which the learner would spend four times a second if
//! it did so in each maintenance call. The learner therefore scans immediately only if the process
//! of a worker's port is gone, which one system call shows. In all other cases, such as a process
//! that died before it had a port, it scans only as often as a fixed share of its time allows.

use iceoryx2::node::Node;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::port_factory::PortFactory as _;
use rustix::io::Errno;
use rustix::process::{Pid, test_kill_process};

use super::channel::Factory;
use super::service::{PrivateIpc, clean};
use crate::transport::TransportError;

/// Nodes scanned per call on average. With up to ten workers every call scans all nodes; with 256
/// workers a scan happens once in six seconds.
const LOOKS: usize = 32;
/// Consecutive failed cleanups before the error is returned. Single failures are normal: a worker
/// that starts or ends during the scan hides the ones behind it.
const FAILURES_MAX: usize = 20;

/// Rate limiter of the scans.
#[derive(Debug, Default)]
pub(super) struct Cleaning {
    /// Scanned nodes that are not yet compensated by calls without a scan.
    owed: usize,
    failures: usize,
}

impl Cleaning {
    /// Cleans up if a scan is due. Call it a few times a second. `died` says that a known process
    /// is gone; for `found_dead` see [`clean`].
    pub(super) fn clean_in_time(
        &mut self,
        node: &Node<PrivateIpc>,
        died: bool,
        found_dead: impl FnMut(),
    ) -> Result<(), TransportError> {
        if !self.is_due(died) {
            return Ok(());
        }
        match clean(node, found_dead) {
            Ok(looked) => *self = Self { owed: looked, failures: 0 },
            Err(error) if self.failures >= FAILURES_MAX => return Err(error),
            Err(_) => self.failures += 1,
        }
        Ok(())
    }

    fn is_due(&mut self, died: bool) -> bool {
        self.owed = self.owed.saturating_sub(LOOKS);
        died || self.owed == 0
    }
}

/// Whether the process of one of the service's ports is gone. A process whose number has been
/// reused, or that lives in another PID namespace, is found by the regular scans.
pub(super) fn sender_died<E, H>(factory: &Factory<E, H>) -> bool
where
    E: core::fmt::Debug + iceoryx2::prelude::ZeroCopySend + 'static,
    H: core::fmt::Debug + iceoryx2::prelude::ZeroCopySend,
{
    let mut died = false;
    factory.dynamic_config().list_publishers(|publisher| {
        let number = publisher.node_id.pid::<PrivateIpc>().ok();
        let pid = number.and_then(|number| Pid::from_raw(number.value()));
        died |= pid.is_some_and(|pid| test_kill_process(pid) == Err(Errno::SRCH));
        CallbackProgression::Continue
    });
    died
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_processes_are_looked_at_every_time_and_many_in_turns() {
        let mut few = Cleaning { owed: LOOKS, failures: 0 };
        assert!(few.is_due(false));
        let mut many = Cleaning { owed: 10 * LOOKS, failures: 0 };
        let calls = (1..).find(|_| many.is_due(false));
        assert_eq!(calls, Some(10));
    }

    #[test]
    fn a_death_is_looked_after_at_once() {
        let mut many = Cleaning { owed: 10 * LOOKS, failures: 0 };
        assert!(many.is_due(true));
        assert!(!many.is_due(false));
    }
}
