//! Decides when the learner cleans up after dead processes.
//!
//! To find dead processes, iceoryx2 reads several files per process, and three times as many for a
//! worker. With 256 workers a scan takes 0.1 s. In every maintenance call, four times per second,
//! that would be too much. The learner therefore scans immediately only if the process of a
//! worker's port is gone, which one system call per port detects. Otherwise it scans at a limited
//! rate, which finds processes that died before they had a port.

use iceoryx2::node::Node;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::port_factory::PortFactory as _;
use rustix::io::Errno;
use rustix::process::{Pid, test_kill_process};

use super::channel::Factory;
use super::service::{PrivateIpc, clean};
use crate::transport::TransportError;

/// Average number of nodes scanned per call. With up to ten workers every call scans all nodes;
/// with 256 workers a scan happens every six seconds.
const NODES_PER_CALL: usize = 32;
/// Consecutive failed cleanups before the error is returned. Single failures are normal: if a
/// worker starts or ends during the scan, the scan stops early.
const FAILURES_MAX: usize = 20;

/// Rate limiter of the scans.
#[derive(Debug, Default)]
pub(super) struct Cleaning {
    /// Scanned nodes above the average. Each call reduces it by [`NODES_PER_CALL`], and the next
    /// regular scan is due at 0.
    excess: usize,
    failures: usize,
}

impl Cleaning {
    /// Cleans up if a scan is due. Call it a few times per second.
    ///
    /// - `died`: whether a known process is gone.
    /// - `found_dead`: see [`clean`].
    pub(super) fn clean_if_due(
        &mut self,
        node: &Node<PrivateIpc>,
        died: bool,
        found_dead: impl FnMut(),
    ) -> Result<(), TransportError> {
        if !self.is_due(died) {
            return Ok(());
        }
        match clean(node, found_dead) {
            Ok(scanned) => *self = Self { excess: scanned, failures: 0 },
            Err(error) if self.failures >= FAILURES_MAX => return Err(error),
            Err(_) => self.failures += 1,
        }
        Ok(())
    }

    fn is_due(&mut self, died: bool) -> bool {
        self.excess = self.excess.saturating_sub(NODES_PER_CALL);
        died || self.excess == 0
    }
}

/// Returns whether the process of one of the service's ports is gone. It misses processes whose PID
/// has been reused or that are in another PID namespace; the regular scans find these.
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
    fn scan_rate_decreases_with_the_number_of_processes() {
        let mut few = Cleaning { excess: NODES_PER_CALL, failures: 0 };
        assert!(few.is_due(false));
        let mut many = Cleaning { excess: 10 * NODES_PER_CALL, failures: 0 };
        let calls = (1..).find(|_| many.is_due(false));
        assert_eq!(calls, Some(10));
    }

    #[test]
    fn death_of_a_process_triggers_a_scan() {
        let mut many = Cleaning { excess: 10 * NODES_PER_CALL, failures: 0 };
        assert!(many.is_due(true));
        assert!(!many.is_due(false));
    }
}
