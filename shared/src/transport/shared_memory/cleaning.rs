//! When the learner cleans up after dead processes.
//!
//! To find the dead, iceoryx2 reads several files of every process that there is, three times for a
//! worker: with 256 workers, 0.1 s, which a learner that did so at each turn of its maintenance
//! would take from its workers four times a second. So it looks at once when the process behind a
//! worker's port is gone, which costs a system call, and for all else, such as a process that died
//! before it had a port, only as often as its share of time allows.

use iceoryx2::node::Node;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::port_factory::PortFactory as _;
use rustix::io::Errno;
use rustix::process::{Pid, test_kill_process};

use super::channel::Factory;
use super::service::{PrivateIpc, clean};
use crate::transport::TransportError;

/// Nodes looked at by each call on average: all of them at every call with up to ten workers, once
/// in six seconds with 256.
const LOOKS: usize = 32;
/// Cleanups that may fail in a row before the caller is told. One is normal: a worker that starts
/// or ends in that moment hides the ones behind it.
const FAILURES_MAX: usize = 20;

/// How much was looked at lately.
#[derive(Debug, Default)]
pub(super) struct Cleaning {
    /// Nodes that were looked at and not yet paid for by calls without a look.
    owed: usize,
    failures: usize,
}

impl Cleaning {
    /// To be called a few times a second; `died`: a process that is known is gone; `found_dead`:
    /// see [`clean`].
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

/// Whether the process behind a port of the service is gone. One whose number another process has
/// by now, or that lives where numbers mean others, is found in time.
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
