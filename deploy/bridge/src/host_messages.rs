//! JSON messages between a host and the gateway: joining, which [`crate::handshake`] authenticates,
//! and the host's status.

use dmprl_control::WorkersNow;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::Sent;
use serde::{Deserialize, Serialize};

/// A host's request to join.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostRequest {
    /// Random number that identifies this start of `dmprl bridge`.
    pub host: u64,
    /// Name of the host, for display.
    pub name: String,
    /// Number of workers.
    pub workers: u32,
    /// True if all messages must be sealed: the host's link is not authenticated itself.
    pub sealed: bool,
    /// Previous places, if the host returns.
    #[serde(rename = "held")]
    pub lease: Option<Lease>,
}

/// The places of a host's workers in the run, which a silent host keeps for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lease {
    /// Index of its first worker in the run.
    pub first: u32,
    /// Session of the run from which its workers' incarnations are derived.
    pub session: u32,
}

/// Answer to a message of the handshake.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum HostAnswer {
    /// The challenge that a request to join must answer.
    Challenge(String),
    /// The host is admitted.
    Welcome(Box<HostWelcome>),
    /// The host is rejected.
    Refused {
        /// The reason and a remedy.
        reason: String,
        /// True if a later request may succeed.
        later: bool,
    },
}

/// Everything that an admitted host needs to know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostWelcome {
    /// Secret part of the names of the messages between this host and the gateway.
    #[serde(rename = "seat")]
    pub channel: u64,
    /// Id of the gateway. Its successor does not know the channel.
    pub gateway: u64,
    /// True if all messages are sealed. False only if both ends have an authenticated link.
    pub sealed: bool,
    /// Places of the host.
    #[serde(rename = "held")]
    pub lease: Lease,
    /// Run id, as in the manifest.
    pub run_id: String,
    /// Configuration, as in the run's `config.toml`.
    pub config: String,
    /// Spec of the run's environment.
    pub spec: EnvSpec,
}

/// Status of a host, sent several times per second.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostStatus {
    /// Version of its policy.
    pub policy_version: u64,
    /// Counts of its workers' segments since the host began.
    pub sent: Sent,
    /// Number of failures of environments since the host began.
    pub env_failures: u64,
    /// State of its workers.
    pub workers: WorkersNow,
    /// True if the host is leaving.
    pub leaves: bool,
}

impl HostStatus {
    /// Raises counts to those of the previous status. A restarted relay reports none until its
    /// supervisor has sent them, and counters must not decrease.
    pub fn no_less_than(&mut self, before: &Self) {
        let (now, then) = (&self.sent, &before.sent);
        let less = now.produced < then.produced
            || now.sent < then.sent
            || now.resent < then.resent
            || now.acked < then.acked
            || self.env_failures < before.env_failures;
        if less {
            (self.sent, self.env_failures) = (before.sent, before.env_failures);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_a_host_never_decrease() {
        let of = |produced, env_failures| HostStatus {
            sent: Sent { produced, sent: 2, ..Sent::default() },
            env_failures,
            ..HostStatus::default()
        };
        let before = of(5, 1);
        let mut status = HostStatus { policy_version: 9, ..HostStatus::default() };
        status.no_less_than(&before);
        assert_eq!(status, HostStatus { policy_version: 9, ..before.clone() });
        let mut more = of(6, 1);
        more.no_less_than(&before);
        assert_eq!(more, of(6, 1));
    }
}
