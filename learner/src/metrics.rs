//! The scalars that a run writes to `metrics.jsonl`, and how they are computed.

use dmprl_shared::segment::{
    Rejection, SUCCESS, SUCCESS_REPORTED, Segment, SegmentLayout, TERMINATED, TRUNCATED,
};
use serde::{Deserialize, Serialize};

use crate::algorithms::Losses;
use crate::algorithms::ndp::NdpLosses;

/// One line of `metrics.jsonl`. Unless stated otherwise, a value covers the time since the previous
/// line. A mean over nothing is null.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MetricsLine {
    /// Environment steps inserted into the replay, over the whole run.
    pub env_steps: u64,
    /// Updates done, over the whole run.
    pub updates: u64,
    /// Segments inserted, over the whole run.
    pub segments: u64,
    /// Hindsight copies inserted, over the whole run.
    #[serde(default)]
    pub hindsight_segments: u64,
    /// Version of the newest published policy.
    pub policy_version: u64,
    /// Segments in the replay, or in the rollout of an on-policy algorithm.
    pub replay_segments: u64,
    /// updates * batch_size / env_steps, over the whole run; on-policy, the segments of a minibatch
    /// instead of batch_size.
    pub samples_per_insert: f64,
    /// Segments rejected, over the whole run, by reason.
    pub rejected: Rejected,
    /// Segments missing in the workers' sequences, over the whole run.
    pub lost: u64,
    /// Segments on the way from workers to learner, over the whole run.
    #[serde(default)]
    pub delivery: DeliveryLine,
    /// Attached workers, including those that joined.
    #[serde(default)]
    pub workers: u64,
    /// Segments that the workers keep until the learner acknowledges them, by their last reports.
    #[serde(default)]
    pub queued_segments: u64,
    /// Restarts of workers after a crash, over the whole run.
    #[serde(default)]
    pub worker_restarts: u64,
    /// Restarts of the learner after a crash, over the whole run.
    #[serde(default)]
    pub learner_restarts: u64,
    /// NDP: segments that were not learned from because an older policy had made them, over the
    /// whole run.
    #[serde(default)]
    pub stale_segments: u64,
    /// Failures of environments, over the whole run. Each costs a segment, or an episode of an
    /// evaluation, and the environment is made again.
    #[serde(default)]
    pub env_failures: u64,
    /// mean (Q - target)^2.
    pub critic_loss: Option<f64>,
    /// -mean Q(s, pi(s)).
    pub actor_loss: Option<f64>,
    /// mean Q over sampled windows.
    pub q_mean: Option<f64>,
    /// SAC: mean weight of the entropy.
    #[serde(default)]
    pub temperature: Option<f64>,
    /// SAC: mean -log pi of the sampled actions. NDP: entropy of the policy in one step \[nat\].
    #[serde(default)]
    pub entropy: Option<f64>,
    /// NDP: mean -min(ratio advantage, clipped ratio advantage).
    #[serde(default)]
    pub policy_loss: Option<f64>,
    /// NDP: mean (V - return)^2.
    #[serde(default)]
    pub value_loss: Option<f64>,
    /// NDP: mean (ratio - 1) - log ratio, which estimates the divergence from the policy that
    /// acted.
    #[serde(default)]
    pub approx_kl: Option<f64>,
    /// NDP: share of steps whose ratio is outside the clipping interval.
    #[serde(default)]
    pub clip_fraction: Option<f64>,
    /// Finished training episodes (with exploration).
    pub episodes: u64,
    /// Mean of their returns.
    pub training_return_mean: Option<f64>,
    /// Share of them that ended in success; null if the task does not report success.
    pub training_success_rate: Option<f64>,
    /// Median policy lag of the segments: newest policy version minus the version that acted.
    pub policy_lag_p50: Option<u64>,
    /// Largest policy lag.
    pub policy_lag_max: Option<u64>,
    /// Updates that the learner owes.
    pub updates_owed: f64,
    /// Training time, over all sessions of the run \[s\].
    pub wall_s: f64,
    /// Environment steps per second.
    pub env_steps_per_s: f64,
    /// Updates per second.
    pub updates_per_s: f64,
}

/// Segments on the way from workers to learner. Workers count the first four and report them once a
/// second, so the last counts of a killed worker are missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeliveryLine {
    /// Finished by a worker.
    pub produced: u64,
    /// Accepted by a queue, including retransmitted ones.
    pub sent: u64,
    /// Retransmitted.
    pub resent: u64,
    /// Acknowledged by the learner, as received by the worker.
    pub acked: u64,
    /// Taken from a queue by the learner: inserted or rejected.
    pub received: u64,
    /// Bytes of incomplete records that a starting learner cut off the end of the segment log.
    pub log_bytes_cut: u64,
}

/// Keys of a [`MetricsLine`] that depend on the clock. Two deterministic runs differ only in these.
pub const TIME_KEYS: [&str; 3] = ["wall_s", "env_steps_per_s", "updates_per_s"];

/// Numbers of rejected segments by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rejected {
    /// Wrong layout version.
    pub layout_version: u64,
    /// Wrong run.
    pub run: u64,
    /// Wrong architecture.
    pub architecture: u64,
    /// Wrong sizes.
    pub sizes: u64,
    /// A header field out of range.
    pub field: u64,
    /// Wrong checksum.
    pub checksum: u64,
    /// A value that is not finite or out of bounds.
    pub value: u64,
    /// A known sequence number, from a retransmission.
    pub duplicate: u64,
}

impl Rejected {
    /// Counts one rejection.
    pub fn count(&mut self, why: Rejection) {
        *self.counter(why) += 1;
    }

    /// Returns the number of rejections for this reason.
    #[must_use]
    pub fn of(mut self, why: Rejection) -> u64 {
        *self.counter(why)
    }

    fn counter(&mut self, why: Rejection) -> &mut u64 {
        match why {
            Rejection::LayoutVersion => &mut self.layout_version,
            Rejection::Run => &mut self.run,
            Rejection::Architecture => &mut self.architecture,
            Rejection::Sizes => &mut self.sizes,
            Rejection::Field => &mut self.field,
            Rejection::Checksum => &mut self.checksum,
            Rejection::Value => &mut self.value,
            Rejection::Duplicate => &mut self.duplicate,
        }
    }

    /// Returns the number of all rejections except duplicates, which are no faults.
    #[must_use]
    pub fn total(&self) -> u64 {
        let Self { layout_version, run, architecture, sizes, field, checksum, value, .. } = self;
        layout_version + run + architecture + sizes + field + checksum + value
    }
}

/// Maximum lags kept for the median of a line; newer ones then replace the oldest.
const LAGS_MAX: usize = 4_096;

/// Collects the values of a line. Its buffers are allocated once.
#[derive(Debug)]
pub struct MetricsCollector {
    layout: SegmentLayout,
    envs_per_worker: usize,
    /// Return so far of each environment's episode.
    returns: Vec<f64>,
    /// Whether the environment's episode was seen from its first step.
    whole: Vec<bool>,
    window: WindowSums,
    lags: Vec<u64>,
    lag_next: usize,
}

/// Sum and count of a mean.
#[derive(Debug, Default)]
struct Mean {
    sum: f64,
    count: u64,
}

impl Mean {
    fn add(&mut self, value: impl Into<Option<f32>>) {
        if let Some(value) = value.into() {
            self.sum += f64::from(value);
            self.count += 1;
        }
    }

    /// Returns the mean, or `None` without values.
    fn value(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }
}

#[derive(Debug, Default)]
struct WindowSums {
    critic_loss: Mean,
    actor_loss: Mean,
    q_mean: Mean,
    temperature: Mean,
    entropy: Mean,
    policy_loss: Mean,
    value_loss: Mean,
    approx_kl: Mean,
    clip_fraction: Mean,
    episodes: u64,
    returns: f64,
    /// Finished episodes that report success or failure.
    success_reported: u64,
    successes: u64,
    lag_max: u64,
}

/// The values of a line that come from a [`MetricsCollector`].
#[derive(Debug, Clone, PartialEq)]
pub struct CollectedMetrics {
    /// Mean (Q - target)^2.
    pub critic_loss: Option<f64>,
    /// Mean loss of the actor.
    pub actor_loss: Option<f64>,
    /// Mean Q of the batches' actions.
    pub q_mean: Option<f64>,
    /// Mean weight of the entropy.
    pub temperature: Option<f64>,
    /// Mean -log pi of the sampled actions, or entropy of the policy.
    pub entropy: Option<f64>,
    /// Mean loss of an on-policy algorithm's policy.
    pub policy_loss: Option<f64>,
    /// Mean loss of an on-policy algorithm's value.
    pub value_loss: Option<f64>,
    /// Mean divergence from the policy that acted.
    pub approx_kl: Option<f64>,
    /// Share of steps whose ratio is outside the clipping interval.
    pub clip_fraction: Option<f64>,
    /// Finished training episodes.
    pub episodes: u64,
    /// Mean of their returns.
    pub return_mean: Option<f64>,
    /// Share of successes among the episodes that report success or failure.
    pub success_rate: Option<f64>,
    /// Policy lag of the segments, if any acted with a policy.
    pub lag: Option<PolicyLag>,
}

/// Newest policy version minus the version that acted, over some segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PolicyLag {
    /// Median.
    pub median: u64,
    /// Largest lag.
    pub max: u64,
}

impl MetricsCollector {
    /// Makes a collector for `workers * envs_per_worker` environments.
    #[must_use]
    pub fn new(layout: SegmentLayout, workers: usize, envs_per_worker: usize) -> Self {
        let envs = workers * envs_per_worker;
        Self {
            layout,
            envs_per_worker,
            returns: vec![0.0; envs],
            whole: vec![false; envs],
            window: WindowSums::default(),
            lags: Vec::with_capacity(LAGS_MAX),
            lag_next: 0,
        }
    }

    /// Adds an update.
    pub fn updated(&mut self, losses: Losses) {
        self.window.critic_loss.add(losses.critic_loss);
        self.window.actor_loss.add(losses.actor_loss);
        self.window.q_mean.add(losses.q_mean);
        self.window.temperature.add(losses.temperature);
        self.window.entropy.add(losses.entropy);
    }

    /// Adds an update of an on-policy algorithm.
    pub fn updated_on_policy(&mut self, losses: NdpLosses) {
        self.window.policy_loss.add(losses.policy_loss);
        self.window.value_loss.add(losses.value_loss);
        self.window.entropy.add(losses.entropy);
        self.window.approx_kl.add(losses.approx_kl);
        self.window.clip_fraction.add(losses.clip_fraction);
    }

    /// Adds an inserted segment; `newest` is the newest policy's version.
    pub fn inserted(&mut self, segment: &Segment, newest: u64) {
        let header = &segment.header;
        if header.policy_version > 0 {
            let lag = newest.saturating_sub(header.policy_version);
            self.window.lag_max = self.window.lag_max.max(lag);
            if self.lags.len() < LAGS_MAX {
                self.lags.push(lag);
            } else {
                self.lags[self.lag_next % LAGS_MAX] = lag;
                self.lag_next += 1;
            }
        }
        let env = header.worker_id as usize * self.envs_per_worker + header.env_index as usize;
        if header.episode_step == 0 {
            self.returns[env] = 0.0;
            self.whole[env] = true;
        }
        let (_, _, rewards) = self.layout.split(&segment.block);
        let rewards = &rewards[..header.steps_len as usize];
        self.returns[env] += rewards.iter().map(|r| f64::from(*r)).sum::<f64>();
        if header.flags & (TERMINATED | TRUNCATED) != 0 {
            if self.whole[env] {
                self.window.episodes += 1;
                self.window.returns += self.returns[env];
                self.window.success_reported += u64::from(header.flags & SUCCESS_REPORTED != 0);
                self.window.successes += u64::from(header.flags & SUCCESS != 0);
            }
            self.whole[env] = false;
        }
    }

    /// Returns the collected values and starts again.
    pub fn take(&mut self) -> CollectedMetrics {
        let window = std::mem::take(&mut self.window);
        let episodes = window.episodes as f64;
        self.lags.sort_unstable();
        let median = self.lags.get(self.lags.len() / 2).copied();
        let lag = median.map(|median| PolicyLag { median, max: window.lag_max });
        self.lags.clear();
        self.lag_next = 0;
        CollectedMetrics {
            critic_loss: window.critic_loss.value(),
            actor_loss: window.actor_loss.value(),
            q_mean: window.q_mean.value(),
            temperature: window.temperature.value(),
            entropy: window.entropy.value(),
            policy_loss: window.policy_loss.value(),
            value_loss: window.value_loss.value(),
            approx_kl: window.approx_kl.value(),
            clip_fraction: window.clip_fraction.value(),
            episodes: window.episodes,
            return_mean: (window.episodes > 0).then(|| window.returns / episodes),
            success_rate: (window.success_reported > 0)
                .then(|| window.successes as f64 / window.success_reported as f64),
            lag,
        }
    }
}
