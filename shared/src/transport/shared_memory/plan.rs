//! The plan: parameters that must be equal in the learner and the workers of a run.

use crate::config::ExperimentConfig;
use crate::policy::Policy;
use crate::segment::SegmentLayout;

/// Version of the protocol between the processes of a run. Peers with another version are rejected.
const PROTOCOL: u32 = 2;

/// Parameters that must be equal in the learner and the workers of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// Id of the run. Workers of another run are rejected.
    pub run_id: u64,
    /// Hash of the policy's architecture. Workers with another one are rejected.
    pub architecture_hash: u64,
    /// Sizes of a segment.
    pub layout: SegmentLayout,
    /// Number of worker slots, each with its own queue.
    pub worker_count: usize,
    /// Capacity of each worker's queue \[segments\].
    pub queue_segments: usize,
    /// Length of a snapshot's values.
    pub parameters_len: usize,
}

impl Plan {
    /// Creates the plan of a run.
    #[must_use]
    pub fn new(config: &ExperimentConfig, run_id: u64, policy: &Policy) -> Self {
        Self {
            run_id,
            architecture_hash: policy.architecture_hash(),
            layout: policy.layout(),
            worker_count: config.places(),
            queue_segments: config.actors.queue_segments,
            parameters_len: policy.parameters_len(),
        }
    }

    /// Returns the attributes of every service, which are compared when a process attaches.
    pub(super) fn identity(&self) -> Vec<(&'static str, String)> {
        vec![
            ("protocol", PROTOCOL.to_string()),
            ("run_id", format!("{:#018x}", self.run_id)),
            ("architecture_hash", format!("{:#018x}", self.architecture_hash)),
        ]
    }
}
