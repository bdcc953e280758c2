//! Other hosts of the run, as reported by the gateway.

use dmprl_control::HostNow;

/// The hosts of the gateway's last report.
#[derive(Debug, Default)]
pub(super) struct Hosts(pub(super) Vec<HostNow>);

impl Hosts {
    /// Number of attached workers of reachable hosts.
    pub(super) fn workers(&self) -> u64 {
        self.0.iter().filter(|host| host.here).map(|host| host.workers).sum()
    }

    /// Number of restarts of all hosts' workers.
    pub(super) fn restarts(&self) -> u64 {
        self.0.iter().map(|host| host.restarts).sum()
    }

    /// Number of unacknowledged segments of all hosts' workers.
    pub(super) fn kept(&self) -> u64 {
        self.0.iter().map(|host| host.kept).sum()
    }

    /// Describes the hosts for the live display.
    pub(super) fn description(&self) -> String {
        if self.0.is_empty() {
            return "waiting for other hosts".to_owned();
        }
        let host = |host: &HostNow| {
            let state = match (host.here, host.workers) {
                (false, _) => "unreachable".to_owned(),
                (true, 1) => "1 worker".to_owned(),
                (true, workers) => format!("{workers} workers"),
            };
            format!("{}: {state}", host.name.escape_debug())
        };
        self.0.iter().map(host).collect::<Vec<_>>().join(", ")
    }
}
