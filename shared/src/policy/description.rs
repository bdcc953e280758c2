//! Serialisable description of a policy, from which it is rebuilt without the run that trained it.
//! The parameters are stored separately.

use serde::{Deserialize, Serialize};

use super::{Policy, PolicyError};
use crate::config::{
    AlgorithmName, ConfigError, DmpConfig, ExperimentConfig, Layers, Limits, PolicyConfig,
    StartSource, WarmUpKind, algorithm_defaults, policy_defaults,
};
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
}

impl PolicyDescription {
    /// Describes the policy that `config` defines for an environment.
    #[must_use]
    pub fn new(config: &ExperimentConfig, spec: &EnvSpec) -> Self {
        Self {
            // A policy acts without knowing rewards.
            spec: EnvSpec { goal_rule: None, ..spec.clone() },
            algorithm: config.algorithm.name,
            policy: config.policy.clone(),
            dmp: config.dmp.clone(),
            start_sources: config.task.start_sources.clone(),
        }
    }

    /// Builds the policy. Checks every value as in a configuration, because the description may
    /// come from an untrusted file.
    ///
    /// # Errors
    /// If a value is out of range or does not fit the environment.
    pub fn build(&self) -> Result<Policy, PolicyError> {
        let config = self.config()?;
        Policy::new(&config, &self.spec)
    }

    /// Returns a configuration with the policy's values and defaults for all others.
    fn config(&self) -> Result<ExperimentConfig, ConfigError> {
        let mut layers = Layers::new();
        for own in [policy_defaults(self.policy.kind), algorithm_defaults(self.algorithm)] {
            layers.add("policy", own.unwrap_or_default())?;
        }
        let mut config = layers.finish()?;
        config.algorithm.name = self.algorithm;
        config.policy = self.policy.clone();
        config.dmp = self.dmp.clone();
        config.task.start_sources.clone_from(&self.start_sources);
        if self.policy.carries_dmp_state() {
            config.exploration.warm_up_kind = WarmUpKind::DmpParameters;
        }
        config.resolve(Limits { cores: 1 })
    }
}
