//! Serialisable description of a policy, from which it is rebuilt without the run that trained it.
//! The parameters are stored separately.

use serde::{Deserialize, Serialize};

use crate::config::{AlgorithmName, DmpConfig, PolicyConfig, StartSource};
use crate::spec::EnvSpec;

/// The parts of a configuration that define a policy: environment, algorithm, policy and DMP.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PolicyDescription {
    /// The environment's sizes, bounds and timing.
    pub spec: EnvSpec,
    /// Algorithm that trained the policy. With SAC and TQC the network also outputs log-stds; with
    /// NDP the policy has learned standard deviations.
    pub algorithm: AlgorithmName,
    /// Kind, network, ranges, controller and start.
    pub policy: PolicyConfig,
    /// The movement primitive; used only by `dmp`.
    pub dmp: DmpConfig,
    /// Entries of an observation from which y0 and yd0 are read, for `start = "observed"`.
    pub start_sources: Vec<StartSource>,
    /// Arguments and wrappers of the environment, which make it another environment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task_options: Option<String>,
}
