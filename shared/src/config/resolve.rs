//! Checks the merged configuration: ranges, combinations and limits.

mod algorithms;

use super::endpoint::{is_endpoint, is_plain};
use super::{
    AfterTimeLimit, AlgorithmName, ConfigError, CriticInput, DeliveryLevel, ExperimentConfig,
    PolicyKind, RangeError, Start, WarmUpKind, Windows, check_hidden, range,
};

/// Properties of the machine, passed in by the caller.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Available processor cores.
    pub cores: usize,
}

/// No experiment needs more; a larger value is probably a typo.
const WORKERS_MAX: usize = 1_024;
/// A thread takes 64 rows of a batch at a time, so more would share the default's 128 unevenly.
const UPDATE_THREADS: usize = 2;
const ENVS_PER_WORKER_MAX: usize = 4_096;
const HINDSIGHT_COPIES_MAX: usize = 64;
/// Enough for a worker that sends 100 000 segments per second and gets 100 acknowledgements per
/// second. At higher rates the learner acknowledges more often.
const SEGMENTS_UNTIL_ACKNOWLEDGED: usize = 1_024;
const UNACKNOWLEDGED_MAX: usize = 1 << 20;
/// Fits a few segments of any size.
const LOG_BYTES_MIN: u64 = 1 << 20;
const LOG_BYTES_MAX: u64 = 1 << 44;
/// A smaller window leaves a link with a long round trip nearly idle. With a larger one, segments
/// that wait for a slow learner come from outdated policies.
const UNDER_WAY_BYTES_MIN: u64 = 1 << 16;
const UNDER_WAY_BYTES_MAX: u64 = 1 << 34;
const UPDATES_PER_SEGMENT_MAX: f64 = 1e6;
/// Heartbeats are sent once per second, and less often on a busy machine.
const HEARTBEAT_S_MIN: f64 = 3.0;
/// About thirty years.
const SECONDS_MAX: f64 = 1e9;
/// The published 50 environment steps of each environment, at K = 5.
const ROLLOUT_SEGMENTS_PER_ENV: usize = 10;

impl ExperimentConfig {
    /// Fills in values that depend on the machine or on other values, and checks every value.
    ///
    /// # Errors
    /// `Range` for the first value that is out of range or conflicts with another.
    pub fn resolve(mut self, limits: Limits) -> Result<Self, ConfigError> {
        if self.actors.workers == 0 {
            self.actors.workers = limits.cores.saturating_sub(1).max(1);
        }
        if self.learner.threads == 0 {
            self.learner.threads = limits.cores.clamp(1, UPDATE_THREADS);
        }
        if self.actors.queue_segments == 0 {
            self.actors.queue_segments = self.actors.envs_per_worker;
        }
        if self.delivery.unacknowledged_segments == 0 {
            self.delivery.unacknowledged_segments =
                self.actors.queue_segments.saturating_add(SEGMENTS_UNTIL_ACKNOWLEDGED);
        }
        if self.run.deterministic {
            self.actors.workers = 1;
            self.actors.joined_max = 0;
            self.bridge.listen.clear();
        }
        if self.algorithm.ndp.rollout_segments == 0 {
            let envs = self.actors.workers.saturating_mul(self.actors.envs_per_worker);
            self.algorithm.ndp.rollout_segments = envs.saturating_mul(ROLLOUT_SEGMENTS_PER_ENV);
        }
        self.task.check()?;
        self.policy.check(&self.dmp, self.algorithm.name)?;
        self.check_counts()?;
        self.check_numbers()?;
        self.check_goals()?;
        self.check_combinations()?;
        self.check_ndp()?;
        self.check_tqc()?;
        self.check_action_penalties()?;
        self.check_backend()?;
        self.check_delivery()?;
        self.check_bridge()?;
        Ok(self)
    }

    fn check_delivery(&self) -> Result<(), RangeError> {
        let log = self.delivery.level == DeliveryLevel::Log;
        range("delivery.level", "log", !(log && self.run.deterministic), || {
            "memory with run.deterministic, which runs in one process and sends no segments".into()
        })?;
        let (key, got) = ("delivery.log_bytes_max", self.delivery.log_bytes_max);
        range(key, got, (LOG_BYTES_MIN..=LOG_BYTES_MAX).contains(&got), || {
            format!("from {LOG_BYTES_MIN} to {LOG_BYTES_MAX}")
        })
    }

    fn check_bridge(&self) -> Result<(), RangeError> {
        for endpoint in &self.bridge.listen {
            range("bridge.listen", endpoint, is_endpoint(endpoint), || {
                "tls/ADDRESS:PORT or tcp/ADDRESS:PORT, such as tls/0.0.0.0:7447".into()
            })?;
            let allowed = self.bridge.allow_plain || !is_plain(endpoint);
            range("bridge.listen", endpoint, allowed, || {
                let encrypted = endpoint.replacen("tcp/", "tls/", 1);
                format!("{encrypted}, which needs no certificates, or bridge.allow_plain = true")
            })?;
        }
        let (key, got) = ("bridge.under_way_bytes_max", self.bridge.under_way_bytes_max);
        range(key, got, (UNDER_WAY_BYTES_MIN..=UNDER_WAY_BYTES_MAX).contains(&got), || {
            format!("from {UNDER_WAY_BYTES_MIN} to {UNDER_WAY_BYTES_MAX}")
        })
    }

    fn check_counts(&self) -> Result<(), RangeError> {
        let counts = [
            ("actors.workers", self.actors.workers, 1, WORKERS_MAX),
            ("actors.joined_max", self.actors.joined_max, 0, WORKERS_MAX),
            ("bridge.workers_max", self.bridge.workers_max, 1, WORKERS_MAX),
            ("actors.envs_per_worker", self.actors.envs_per_worker, 1, ENVS_PER_WORKER_MAX),
            ("actors.queue_segments", self.actors.queue_segments, 1, 65_536),
            (
                "delivery.unacknowledged_segments",
                self.delivery.unacknowledged_segments,
                1,
                UNACKNOWLEDGED_MAX,
            ),
            ("algorithm.batch_size", self.algorithm.batch_size, 1, 1 << 20),
            ("replay.capacity_steps", self.replay.capacity_steps, 1_000, 1 << 31),
            ("replay.hindsight_copies", self.replay.hindsight_copies, 1, HINDSIGHT_COPIES_MAX),
            ("learner.threads", self.learner.threads, 1, 1_024),
            ("evaluation.episodes", self.evaluation.episodes, 1, 1_000_000),
            ("evaluation.final_episodes", self.evaluation.final_episodes, 0, 1_000_000),
            ("checkpoint.keep", self.checkpoint.keep, 1, 10_000),
        ];
        for (key, got, low, high) in counts {
            range(key, got, (low..=high).contains(&got), || format!("from {low} to {high}"))?;
        }
        check_hidden("algorithm.critic_hidden", &self.algorithm.critic_hidden)?;
        let intervals = [
            ("run.steps", self.run.steps),
            ("evaluation.interval_steps", self.evaluation.interval_steps),
            ("checkpoint.interval_steps", self.checkpoint.interval_steps),
            ("metrics.interval_steps", self.metrics.interval_steps),
            ("learner.publish_every_updates", self.learner.publish_every_updates),
            ("pacing.tolerance_segments", self.pacing.tolerance_segments),
        ];
        intervals
            .iter()
            .try_for_each(|&(key, got)| range(key, got, got > 0, || "at least 1".into()))
    }

    fn check_numbers(&self) -> Result<(), RangeError> {
        let positive = [
            ("algorithm.critic_learning_rate", self.algorithm.critic_learning_rate),
            ("algorithm.actor_learning_rate", self.algorithm.actor_learning_rate),
            ("algorithm.td3.target_noise_clip", self.algorithm.td3.target_noise_clip),
            ("algorithm.sac.initial_temperature", self.algorithm.sac.initial_temperature),
            (
                "algorithm.sac.temperature_learning_rate",
                self.algorithm.sac.temperature_learning_rate,
            ),
        ];
        for (key, got) in positive {
            range(key, got, got.is_finite() && got > 0.0, || "a positive number".into())?;
        }
        let bounded = [
            (
                "pacing.updates_per_segment",
                self.pacing.updates_per_segment,
                UPDATES_PER_SEGMENT_MAX,
            ),
            ("actors.send_deadline_s", self.actors.send_deadline_s, SECONDS_MAX),
            ("actors.env_call_timeout_s", self.actors.env_call_timeout_s, SECONDS_MAX),
        ];
        for (key, got, max) in bounded {
            range(key, got, got > 0.0 && got <= max, || format!("above 0, at most {max}"))?;
        }
        let timeouts = [
            ("supervision.heartbeat_timeout_s", self.supervision.heartbeat_timeout_s),
            ("supervision.learner_timeout_s", self.supervision.learner_timeout_s),
        ];
        for (key, got) in timeouts {
            range(key, got, (HEARTBEAT_S_MIN..=SECONDS_MAX).contains(&got), || {
                format!("{HEARTBEAT_S_MIN} to {SECONDS_MAX}; a process reports every second")
            })?;
        }
        let run = &self.run;
        let goals =
            [("run.until_return", run.until_return), ("run.until_success", run.until_success)];
        for (key, got) in goals {
            range(key, got, !got.is_nan(), || "a number (inf: none)".into())?;
        }
        let unit = [
            ("algorithm.discount", self.algorithm.discount),
            ("algorithm.polyak", self.algorithm.polyak),
            ("exploration.warm_up_range", self.exploration.warm_up_range),
        ];
        for (key, got) in unit {
            range(key, got, got > 0.0 && got <= 1.0, || "above 0, at most 1".into())?;
        }
        for (key, std) in [
            ("exploration.std", self.exploration.std),
            ("algorithm.td3.target_noise_std", self.algorithm.td3.target_noise_std),
        ] {
            range(key, std, std.is_finite() && std >= 0.0, || "0 or more".into())?;
        }
        let interval = self.algorithm.td3.actor_interval;
        range("algorithm.td3.actor_interval", interval, interval > 0, || "1 or more".into())?;
        let entropy = self.algorithm.sac.target_entropy_per_action;
        let key = "algorithm.sac.target_entropy_per_action";
        range(key, entropy, entropy.is_finite(), || "a finite number".into())?;
        let minutes = self.run.max_minutes;
        range("run.max_minutes", minutes, minutes > 0.0, || "above 0 (inf: no limit)".into())
    }

    fn check_goals(&self) -> Result<(), RangeError> {
        let random = self.exploration.random_segments;
        let shares = [
            ("replay.hindsight_share", self.replay.hindsight_share),
            ("replay.other_goals_share", self.replay.other_goals_share),
            ("replay.near_misses_share", self.replay.near_misses_share),
            ("replay.moved_share", self.replay.moved_share),
            ("demonstrations.share", self.demonstrations.share),
            ("exploration.random_segments", random),
            ("exploration.settled_share", self.exploration.settled_share),
            ("exploration.goal_switches", self.exploration.goal_switches),
            ("algorithm.td3.target_smaller_weight", self.algorithm.td3.target_smaller_weight),
            ("learner.average_share", self.learner.average_share),
        ];
        for (key, got) in shares {
            range(key, got, (0.0..=1.0).contains(&got), || "from 0 to 1".into())?;
        }
        let bonus = self.algorithm.motion_bonus;
        range("algorithm.motion_bonus", bonus, bonus.is_finite() && bonus >= 0.0, || {
            "0 or more".into()
        })?;
        let carry = self.policy.carries_dmp_state();
        range("exploration.random_segments", random, !carry || random == 0.0, || {
            "0 with policy.start = \"carry\", because random actions leave y undefined".into()
        })?;
        let on_policy = self.algorithm.name == AlgorithmName::Ndp;
        range("exploration.random_segments", random, !on_policy || random == 0.0, || {
            "0 with algorithm.name = \"ndp\", which learns only from actions of its own policy"
                .into()
        })
    }

    fn check_combinations(&self) -> Result<(), RangeError> {
        let first = self.algorithm.critic == CriticInput::First;
        let sliding = self.algorithm.windows == Windows::Sliding;
        let several = self.policy.decision_steps() > 1;
        range("algorithm.windows", "sliding", !(first && sliding && several), || {
            "segment with algorithm.critic = \"first\": the actions of a sliding window can come \
             from two decisions"
                .into()
        })?;
        let literal = self.algorithm.target == super::Target::Literal;
        range("algorithm.target", "literal", !(literal && sliding && several), || {
            "n_step, or algorithm.windows = \"segment\", which the literal target requires".into()
        })?;
        let holds = self.algorithm.after_time_limit == AfterTimeLimit::LastReward;
        let on_policy = self.algorithm.name == AlgorithmName::Ndp;
        let fits = !holds || !(literal || on_policy || self.algorithm.discount == 1.0);
        range("algorithm.after_time_limit", "last_reward", fits, || {
            "bootstrap with algorithm.target = \"literal\", algorithm.discount = 1 or \
             algorithm.name = \"ndp\""
                .into()
        })?;
        let (dmp, kind) = (self.policy.kind == PolicyKind::Dmp, self.policy.kind.name());
        let draws_dmp_parameters = self.exploration.warm_up_kind == WarmUpKind::DmpParameters;
        range("exploration.warm_up_kind", "dmp_parameters", dmp || !draws_dmp_parameters, || {
            format!("uniform with policy.kind = \"{kind}\", which has no DMP parameters")
        })?;
        let perturbs_dmp_parameters =
            self.exploration.kind == super::ExplorationKind::DmpParameters;
        range("exploration.kind", "dmp_parameters", dmp || !perturbs_dmp_parameters, || {
            format!("another kind with policy.kind = \"{kind}\", which has no DMP parameters")
        })?;
        let carry = self.policy.carries_dmp_state();
        range("exploration.warm_up_kind", "uniform", draws_dmp_parameters || !carry, || {
            "dmp_parameters with policy.start = \"carry\", because uniform actions leave y \
             undefined during the warm-up"
                .into()
        })?;
        let demonstrated = !self.demonstrations.files.is_empty();
        range("policy.start", "carry", !(carry && demonstrated), || {
            "zero, observed or action with demonstrations, which do not contain the state of a DMP"
                .into()
        })?;
        let observed = dmp && self.policy.start == Start::Observed;
        let sources = self.task.start_sources.len();
        range("policy.start", "observed", !observed || sources > 0, || {
            format!(
                "zero, carry or action; task `{}` has no task.start_sources to read y0 from",
                self.task.name
            )
        })?;
        let cost = self.algorithm.jerk_cost;
        range("algorithm.jerk_cost", cost, cost == 0.0 || sources > 0, || {
            format!(
                "0; task `{}` has no task.start_sources to read velocities from",
                self.task.name
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Layers, PRESETS, TASKS};
    use super::*;

    const LIMITS: Limits = Limits { cores: 2 };

    fn resolved(keys: &[(&str, &str)]) -> Result<ExperimentConfig, ConfigError> {
        let mut layers = Layers::new();
        for (key, value) in keys {
            layers.set("--set", key, value)?;
        }
        layers.finish()?.resolve(LIMITS)
    }

    #[test]
    fn every_task_resolves_with_every_preset() {
        for task in &TASKS {
            for preset in &PRESETS {
                let mut layers = Layers::new();
                layers.add(task.name, task.table()).unwrap();
                layers.add(preset.name, preset.table()).unwrap();
                layers.finish().unwrap().resolve(LIMITS).unwrap();
            }
        }
    }

    #[test]
    fn the_update_has_two_threads_on_two_cores() {
        let threads = |cores| {
            let layers = Layers::new().finish().unwrap();
            layers.resolve(Limits { cores }).unwrap().learner.threads
        };
        assert_eq!([1, 2, 16].map(threads), [1, 2, 2]);
        assert_eq!(resolved(&[("learner.threads", "3")]).unwrap().learner.threads, 3);
    }

    #[test]
    fn workers_default_to_one_less_than_the_cores() {
        assert_eq!(resolved(&[]).unwrap().actors.workers, 1);
        let queue = |pairs| resolved(pairs).unwrap().actors.queue_segments;
        assert_eq!(queue(&[("actors.envs_per_worker", "16")]), 16);
        assert_eq!(queue(&[("actors.queue_segments", "3")]), 3);
        assert_eq!(
            ExperimentConfig::default().resolve(Limits { cores: 8 }).unwrap().actors.workers,
            7
        );
    }

    #[test]
    fn only_a_primitive_needs_integration_steps_that_fit() {
        let of = |kind| resolved(&[("policy.segment_steps", "7"), ("policy.kind", kind)]);
        assert!(of("dmp").is_err() && of("chunk").is_ok());
    }

    #[test]
    fn last_reward_needs_a_discount_and_n_step_targets() {
        let of = |more| resolved(&[("algorithm.after_time_limit", "last_reward"), more]);
        assert!(of(("algorithm.discount", "0.95")).is_ok());
        let segment = [("algorithm.windows", "segment"), ("algorithm.target", "literal")];
        let last = ("algorithm.after_time_limit", "last_reward");
        for keys in [vec![last, segment[0], segment[1]], vec![last, ("algorithm.discount", "1")]] {
            let error = resolved(&keys).unwrap_err().to_string();
            assert!(error.contains("algorithm.after_time_limit"), "{error}");
        }
    }

    #[test]
    fn ndp_requires_movement_primitives_and_no_warm_up() {
        let ndp = ("algorithm.name", "ndp");
        let no_warm_up = ("exploration.warm_up_steps", "0");
        let no_penalty = ("algorithm.action_rate_penalty", "0.0");
        let config = resolved(&[ndp, no_warm_up, no_penalty, ("actors.workers", "3")]).unwrap();
        assert_eq!(config.algorithm.ndp.rollout_segments, 10 * 3 * 8);
        let error = |more| resolved(&[ndp, no_warm_up, no_penalty, more]).unwrap_err().to_string();
        let other = ["mlp", "chunk"].map(|kind| error(("policy.kind", kind)));
        assert!(other.iter().all(|text| text.contains("only movement primitives")), "{other:?}");
        assert!(error(("exploration.warm_up_steps", "1")).contains("its own policy"));
        assert!(error(("algorithm.action_rate_penalty", "0.1")).contains("the other algorithms"));
        assert!(error(("policy.start", "observed")).contains("start_sources"));
        let keys = [("policy.controller", "position"), ("policy.start", "action")];
        let error = resolved(&[&[ndp, no_warm_up, no_penalty], &keys[..]].concat()).unwrap_err();
        assert!(error.to_string().contains("no positions"), "{error}");
    }

    #[test]
    fn updates_are_graphs_where_there_are_no_kernels_and_on_request() {
        let by_graph = |keys: &[_]| resolved(keys).map(|config| config.updates_by_graph());
        let (td3, tqc) = (("algorithm.name", "td3"), ("algorithm.name", "tqc"));
        let (kernels, graph) = (("learner.backend", "kernels"), ("learner.backend", "graph"));
        assert!(!by_graph(&[td3]).unwrap() && !by_graph(&[td3, kernels]).unwrap());
        assert!(by_graph(&[td3, graph]).unwrap() && by_graph(&[tqc]).unwrap());
        let error = by_graph(&[tqc, kernels]).unwrap_err().to_string();
        assert!(error.contains("learner.backend") && error.contains("auto or graph"), "{error}");
        let error = by_graph(&[tqc, ("learner.precision", "bf16")]).unwrap_err().to_string();
        assert!(error.contains("learner.precision"), "{error}");
    }

    #[test]
    fn values_out_of_range_are_rejected() {
        for (key, value) in [
            ("dmp.alpha_y", "70"),
            ("dmp.integration_steps", "41"),
            ("algorithm.discount", "1.5"),
            ("algorithm.polyak", "nan"),
            ("algorithm.action_rate_penalty", "-0.1"),
            ("algorithm.action_acceleration_penalty", "inf"),
            ("algorithm.jerk_cost", "-0.1"),
            ("algorithm.saturation_penalty", "-1"),
            ("algorithm.imitation_penalty", "-1"),
            ("learner.average_share", "1.5"),
            ("replay.hindsight_share", "1.1"),
            ("replay.other_goals_share", "1.1"),
            ("replay.near_misses_share", "1.1"),
            ("replay.moved_share", "-0.1"),
            ("algorithm.motion_bonus", "-1"),
            ("exploration.random_segments", "-0.1"),
            ("exploration.settled_share", "1.1"),
            ("exploration.goal_switches", "1.1"),
            ("demonstrations.share", "1.1"),
            ("algorithm.td3.target_smaller_weight", "1.1"),
            ("algorithm.tqc.critics", "11"),
            ("algorithm.tqc.dropped_quantiles", "25"),
            ("actors.workers", "1000000"),
            ("actors.env_call_timeout_s", "0"),
            ("actors.env_call_timeout_s", "inf"),
            ("actors.send_deadline_s", "1e300"),
            ("run.until_return", "nan"),
            ("supervision.heartbeat_timeout_s", "2.9"),
            ("supervision.learner_timeout_s", "2.9"),
            ("policy.hidden", "[]"),
            ("algorithm.critic", "first"),
            ("algorithm.target", "literal"),
            ("policy.start", "carry"),
            ("policy.start", "observed"),
            ("policy.controller", "position"),
            ("algorithm.name", "ndp"),
            ("algorithm.ndp.clip", "0"),
            ("algorithm.ndp.gae_lambda", "1.1"),
            ("algorithm.ndp.minibatches", "0"),
            ("algorithm.ndp.initial_log_std", "nan"),
        ] {
            let message = resolved(&[(key, value)]).unwrap_err().to_string();
            assert!(message.contains("expected"), "{key} = {value}: {message}");
        }
    }
}
