//! Checks of the algorithms' own settings and of what computes their updates.

use crate::config::{
    AlgorithmName, Backend, Device, ExperimentConfig, Hindsight, Precision, RangeError, TqcConfig,
    range,
};

const QUANTILES_MAX: usize = 200;

impl ExperimentConfig {
    pub(super) fn check_ndp(&self) -> Result<(), RangeError> {
        let ndp = &self.algorithm.ndp;
        let counts = [
            ("algorithm.ndp.rollout_segments", ndp.rollout_segments, 1 << 24),
            ("algorithm.ndp.epochs", ndp.epochs, 10_000),
            ("algorithm.ndp.minibatches", ndp.minibatches, 1 << 24),
        ];
        for (key, got, high) in counts {
            range(key, got, (1..=high).contains(&got), || format!("from 1 to {high}"))?;
        }
        let positive = [
            ("algorithm.ndp.clip", ndp.clip),
            ("algorithm.ndp.gradient_norm_max", ndp.gradient_norm_max),
        ];
        for (key, got) in positive {
            range(key, got, got.is_finite() && got > 0.0, || "a positive number".into())?;
        }
        let lambda = ndp.gae_lambda;
        let fits = (0.0..=1.0).contains(&lambda);
        range("algorithm.ndp.gae_lambda", lambda, fits, || "from 0 to 1".into())?;
        let entropy = ndp.entropy_coefficient;
        let fits = entropy.is_finite() && entropy >= 0.0;
        range("algorithm.ndp.entropy_coefficient", entropy, fits, || "0 or more".into())?;
        let log_std = ndp.initial_log_std;
        let fits = (-10.0..=2.0).contains(&log_std);
        range("algorithm.ndp.initial_log_std", log_std, fits, || "from -10 to 2".into())?;
        let on_policy = self.algorithm.name == AlgorithmName::Ndp;
        let warm_up = self.exploration.warm_up_steps;
        range("exploration.warm_up_steps", warm_up, !on_policy || warm_up == 0, || {
            "0 with algorithm.name = \"ndp\", which learns only from actions of its own policy"
                .into()
        })?;
        let on_cpu = self.learner.device == Device::Cpu;
        range("learner.device", "cuda", !on_policy || on_cpu, || {
            "cpu with algorithm.name = \"ndp\", whose minibatches are too small for a GPU".into()
        })?;
        let graph = self.learner.backend == Backend::Graph;
        range("learner.backend", "graph", !on_policy || !graph, || {
            "auto or kernels with algorithm.name = \"ndp\", which has no graph".into()
        })?;
        let relabels = self.replay.hindsight != Hindsight::None;
        range("replay.hindsight", "future", !on_policy || !relabels, || {
            "none with algorithm.name = \"ndp\", which has no replay".into()
        })?;
        let demonstrated = !self.demonstrations.files.is_empty();
        range("demonstrations.files", "files", !on_policy || !demonstrated, || {
            "none with algorithm.name = \"ndp\", which has no replay".into()
        })?;
        let layer_norm = self.algorithm.critic_layer_norm;
        range("algorithm.critic_layer_norm", "true", !on_policy || !layer_norm, || {
            "false with algorithm.name = \"ndp\"; the other algorithms support it".into()
        })
    }

    pub(super) fn check_action_penalties(&self) -> Result<(), RangeError> {
        let on_policy = self.algorithm.name == AlgorithmName::Ndp;
        for (key, penalty) in [
            ("algorithm.action_rate_penalty", self.algorithm.action_rate_penalty),
            ("algorithm.action_acceleration_penalty", self.algorithm.action_acceleration_penalty),
            ("algorithm.jerk_cost", self.algorithm.jerk_cost),
            ("algorithm.imitation_penalty", self.algorithm.imitation_penalty),
            ("algorithm.saturation_penalty", self.algorithm.saturation_penalty),
        ] {
            range(key, penalty, penalty.is_finite() && penalty >= 0.0, || "0 or more".into())?;
            range(key, penalty, !on_policy || penalty == 0.0, || {
                "0 with algorithm.name = \"ndp\"; the other algorithms support it".into()
            })?;
        }
        Ok(())
    }

    pub(super) fn check_tqc(&self) -> Result<(), RangeError> {
        let tqc = &self.algorithm.tqc;
        let counts = [
            ("algorithm.tqc.critics", tqc.critics, TqcConfig::CRITICS_MAX),
            ("algorithm.tqc.quantiles", tqc.quantiles, QUANTILES_MAX),
        ];
        for (key, got, high) in counts {
            range(key, got, (1..=high).contains(&got), || format!("from 1 to {high}"))?;
        }
        let dropped = tqc.dropped_quantiles;
        range("algorithm.tqc.dropped_quantiles", dropped, dropped < tqc.quantiles, || {
            format!("less than algorithm.tqc.quantiles = {}", tqc.quantiles)
        })
    }

    /// Only the kernels have 16-bit products.
    pub(super) fn check_backend(&self) -> Result<(), RangeError> {
        let kernels = self.learner.backend == Backend::Kernels;
        range("learner.backend", "kernels", !kernels || self.has_kernels(), || {
            "auto or graph: there are kernels only for ddpg, td3, sac and ndp on the CPU".into()
        })?;
        let bf16 = self.learner.precision == Precision::Bf16;
        range("learner.precision", "bf16", !bf16 || !self.updates_by_graph(), || {
            "f32 where updates are graphs (learner.backend = \"graph\", learner.device = \"cuda\", \
             or algorithm.name = \"tqc\")"
                .into()
        })
    }
}
