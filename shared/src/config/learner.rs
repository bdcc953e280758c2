//! The section about the learner process.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Device that computes the updates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The CPU.
    Cpu,
    /// An NVIDIA GPU. Needs a build with the feature `cuda`.
    Cuda,
}

/// What computes an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Backend {
    /// Kernels, or a graph where there are none: on another device, and with `tqc`.
    Auto,
    /// Our own kernels with gradients derived by hand, the fastest.
    Kernels,
    /// Losses on candle's graph with automatic differentiation: for new algorithms, and to check
    /// the kernels.
    Graph,
}

/// Precision of the multiplications in an update. Sums and parameters are always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32 bits.
    F32,
    /// 16 bits (bfloat16): faster, with about three significant digits. Needs a processor with
    /// AVX512-BF16.
    Bf16,
}

/// The learner process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LearnerConfig {
    /// Device that computes the updates.
    pub device: Device,
    /// What computes an update.
    pub backend: Backend,
    /// Threads that compute an update by kernels; 0 means 2, or 1 on a machine with one core.
    /// Results are bit-identical for every number of threads. A graph on the CPU uses one, unless
    /// the environment variable `RAYON_NUM_THREADS` has more.
    pub threads: usize,
    /// Precision of the multiplications in an update. Sums and parameters are always f32.
    pub precision: Precision,
    /// Updates between two published versions of the policy.
    pub publish_every_updates: u64,
    /// The policy that is saved and evaluated is an average of the newest ones, about this share of
    /// all policies so far. Workers use the newest one. 0: the newest one is saved, too.
    pub average_share: f64,
}

impl Default for LearnerConfig {
    fn default() -> Self {
        Self {
            device: Device::Cpu,
            backend: Backend::Auto,
            threads: 0,
            precision: Precision::F32,
            publish_every_updates: 4,
            average_share: 0.05,
        }
    }
}
