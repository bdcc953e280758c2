//! The learning algorithms, of which some have policies of their own kind.

#[cfg(feature = "schema")]
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Algorithm that updates the networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum AlgorithmName {
    /// Deep deterministic policy gradient (Lillicrap et al. 2016); called DDPG-DMP with segments.
    Ddpg,
    /// Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018).
    Td3,
    /// Soft actor-critic with a learned temperature (Haarnoja et al. 2018b).
    Sac,
    /// Truncated quantile critics (Kuznetsov et al. 2020), as a graph.
    Tqc,
    /// Neural Dynamic Policies (Bahl et al. 2020): proximal policy optimisation, on-policy.
    Ndp,
}

impl AlgorithmName {
    /// All algorithms.
    pub const ALL: [Self; 5] = [Self::Ddpg, Self::Td3, Self::Sac, Self::Tqc, Self::Ndp];

    /// Returns the name in configuration files and of run directories.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Ddpg => "ddpg",
            Self::Td3 => "td3",
            Self::Sac => "sac",
            Self::Tqc => "tqc",
            Self::Ndp => "ndp",
        }
    }

    /// Returns true if the policy is SAC's: a squashed Gaussian whose spread the network outputs.
    #[must_use]
    pub fn has_gaussian_policy(self) -> bool {
        matches!(self, Self::Sac | Self::Tqc)
    }

    /// Returns true if there are no kernels for the algorithm, only a graph.
    #[must_use]
    pub fn is_graph_only(self) -> bool {
        self == Self::Tqc
    }
}
