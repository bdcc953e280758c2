//! What is counted over all processes of a session: failures of environments, what was sent, and
//! the workers themselves.

use super::Process;
use super::supervisor::Supervisor;
use crate::control::{Command, HostNow, WorkersNow};
use crate::terminal::grouped;

impl Supervisor<'_> {
    /// Shows the first failure and then whenever their number has doubled: an environment that
    /// fails now and then must not fill the terminal. The process's log has each.
    pub(super) fn on_env_failures(&mut self, process: Process, count: u64, last: &str) {
        let before = self.env_failures;
        self.env_failures = before.saturating_add(count);
        if is_told(before, self.env_failures) {
            self.message(&format!(
                "{process}: environment failure {}: {last}; its segment is not used; {}",
                grouped(self.env_failures),
                self.log_of(process)
            ));
        }
        self.tell_learner_of_counts();
    }

    /// Its process has said so with its last words; its exit follows.
    pub(super) fn on_env_hung(&mut self, process: Process, message: &str) {
        self.env_failures = self.env_failures.saturating_add(1);
        self.message(&format!("{process}: {message}"));
        self.tell_learner_of_counts();
    }

    /// The learner keeps what is counted elsewhere for metrics and checkpoints: the numbers of the
    /// whole run, so one that does not reach a learner is made up for by the next.
    pub(super) fn tell_learner_of_counts(&mut self) {
        if self.is_one_process() {
            return;
        }
        let Some(learner) = self.running(self.hub()) else { return };
        // A learner that takes no commands is stuck or dying; its deadline or its exit follows.
        let _ = learner
            .child
            .send(Command::EnvFailures { total: self.earlier.env_failures + self.env_failures });
        let mut sent = self.earlier.sent;
        sent += self.sent;
        let _ = learner.child.send(Command::Sent(sent));
        let of_hosts = |of: fn(&HostNow) -> u64| self.hosts.iter().map(of).sum::<u64>();
        let _ = learner.child.send(Command::Workers(WorkersNow {
            count: self.workers() as u64
                + of_hosts(|host| if host.here { host.workers } else { 0 }),
            restarts: self.earlier.worker_restarts
                + self.worker_restarts
                + of_hosts(|host| host.restarts),
            queued_segments: self.all_running().map(|(_, running)| running.kept).sum::<u64>()
                + of_hosts(|host| host.kept),
        }));
    }
}

/// Whether a power of two lies between the two counts, the second included.
fn is_told(before: u64, after: u64) -> bool {
    after > before && after.checked_ilog2() != before.checked_ilog2()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_and_every_doubling_are_told() {
        let told: Vec<u64> = (1..=40).filter(|&count| is_told(count - 1, count)).collect();
        assert_eq!(told, [1, 2, 4, 8, 16, 32]);
        assert!(is_told(5, 9) && !is_told(5, 7) && !is_told(3, 3) && !is_told(0, 0));
    }
}
