//! Every scalar that a run writes to `metrics.jsonl`, with how it is computed.

use dmprl_shared::segment::{
    Rejection, SUCCESS, SUCCESS_REPORTED, Segment, SegmentLayout, TERMINATED, TRUNCATED,
};
use serde::{Deserialize, Serialize};

use crate::algorithms::Losses;
use crate::algorithms::ndp::NdpLosses;

/// One line of `metrics.jsonl`. "Since the last line" is meant where nothing else is said; a mean
/// over nothing is null.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MetricsLine {
    /// Environment steps inserted into the replay, over the whole run.
    pub env_steps: u64,
    /// Updates done, over the whole run.
    pub updates: u64,
    /// Segments inserted, over the whole run.
    pub segments: u64,
    /// Copies of segments with other goals inserted, over the whole run.
    #[serde(default)]
    pub hindsight_segments: u64,
    /// Version of the newest published policy.
    pub policy_version: u64,
    /// Segments held by the replay.
    pub replay_segments: u64,
    /// updates * batch_size / env_steps, over the whole run.
    pub samples_per_insert: f64,
    /// Segments refused, over the whole run, by reason.
    pub rejected: Rejected,
    /// Segments missing in the sequences of the workers that the learner has heard from, over the
    /// whole run.
    pub lost: u64,
    /// On the way from workers to learner, over the whole run.
    #[serde(default)]
    pub delivery: DeliveryLine,
    /// Workers that are attached, those that have joined included.
    #[serde(default)]
    pub workers: u64,
    /// Segments that they keep until the learner acknowledges them, as they told last.
    #[serde(default)]
    pub queued_segments: u64,
    /// Starts of workers after a death, over the whole run.
    #[serde(default)]
    pub worker_restarts: u64,
    /// Starts of the learner after a death within a session, over the whole run.
    #[serde(default)]
    pub learner_restarts: u64,
    /// NDP: segments of another policy than the one that was to be learned from, over the whole
    /// run: environment steps that taught nothing.
    #[serde(default)]
    pub stale_segments: u64,
    /// Failures of environments, over the whole run: each cost a segment, or an episode of an
    /// evaluation, and the environment was made again.
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
    /// SAC: mean -log pi of the actor's draws; NDP: the policy's in one step \[nat\].
    #[serde(default)]
    pub entropy: Option<f64>,
    /// NDP: mean -min(ratio advantage, clipped ratio advantage).
    #[serde(default)]
    pub policy_loss: Option<f64>,
    /// NDP: mean (V - return)^2.
    #[serde(default)]
    pub value_loss: Option<f64>,
    /// NDP: mean (ratio - 1) - log ratio, a divergence from the policy that acted.
    #[serde(default)]
    pub approx_kl: Option<f64>,
    /// NDP: share of steps whose ratio lies beyond the clip.
    #[serde(default)]
    pub clip_fraction: Option<f64>,
    /// Training episodes (with exploration) that ended.
    pub episodes: u64,
    /// Mean of their returns.
    pub training_return_mean: Option<f64>,
    /// Share of them that ended in success; null if the task does not report it.
    pub training_success_rate: Option<f64>,
    /// Median over segments: newest policy version minus the one that acted.
    pub policy_lag_p50: Option<u64>,
    /// Largest of them.
    pub policy_lag_max: Option<u64>,
    /// Updates owed by the pacing.
    pub updates_owed: f64,
    /// Seconds of training, over all sessions of the run.
    pub wall_s: f64,
    /// Environment steps per second.
    pub env_steps_per_s: f64,
    /// Updates per second.
    pub updates_per_s: f64,
}

/// Segments on the way from workers to learner. The first four are counted by the workers, which
/// report them once a second: what one had not reported when it was killed is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeliveryLine {
    /// Finished by a worker.
    pub produced: u64,
    /// Taken by a queue, those that were sent again included.
    pub sent: u64,
    /// Of these, sent again.
    pub resent: u64,
    /// Acknowledged by the learner, and heard by the worker.
    pub acked: u64,
    /// Taken from a queue by the learner: inserted or refused.
    pub received: u64,
    /// Bytes behind the last whole record of the segment log, cut off when a learner started.
    pub log_bytes_cut: u64,
}

/// Keys of a [`MetricsLine`] that depend on the clock: two deterministic runs differ in these only.
pub const TIME_KEYS: [&str; 3] = ["wall_s", "env_steps_per_s", "updates_per_s"];

/// Counts refused segments by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rejected {
    /// Another layout version.
    pub layout_version: u64,
    /// Another run.
    pub run: u64,
    /// Another architecture.
    pub architecture: u64,
    /// Sizes differ.
    pub sizes: u64,
    /// A header field out of range.
    pub field: u64,
    /// The checksum differs.
    pub checksum: u64,
    /// A value that is not finite or out of bounds.
    pub value: u64,
    /// A sequence number used before: sent again to a learner that had it.
    pub duplicate: u64,
}

impl Rejected {
    /// Counts one.
    pub fn count(&mut self, why: Rejection) {
        *self.counter(why) += 1;
    }

    /// How many were refused for this reason.
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

    /// All together but duplicates, which belong to sending again what may be lost: faults.
    #[must_use]
    pub fn total(&self) -> u64 {
        let Self { layout_version, run, architecture, sizes, field, checksum, value, .. } = self;
        layout_version + run + architecture + sizes + field + checksum + value
    }
}

/// Lags kept for the median between two lines; beyond it the oldest make room.
const LAGS_MAX: usize = 4_096;

/// Collects between two lines. Buffers are made once.
#[derive(Debug)]
pub struct Collector {
    layout: SegmentLayout,
    envs_per_worker: usize,
    /// Return so far of every environment's episode.
    returns: Vec<f64>,
    /// Whether the environment's episode was seen from its first step.
    whole: Vec<bool>,
    window: Sums,
    lags: Vec<u64>,
    lag_next: usize,
}

/// A mean in the making.
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

    /// None over nothing.
    fn value(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }
}

#[derive(Debug, Default)]
struct Sums {
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
    /// Ended episodes that said whether they succeeded, and those that did.
    judged: u64,
    successes: u64,
    lag_max: u64,
}

/// What a line takes from a [`Collector`].
#[derive(Debug, Clone, PartialEq)]
pub struct Collected {
    /// Mean (Q - target)^2.
    pub critic_loss: Option<f64>,
    /// Mean of what the actor descends.
    pub actor_loss: Option<f64>,
    /// Mean Q of the batches' actions.
    pub q_mean: Option<f64>,
    /// Mean weight of the entropy.
    pub temperature: Option<f64>,
    /// Mean -log pi of the actor's draws, or entropy of the policy.
    pub entropy: Option<f64>,
    /// Mean of what an on-policy algorithm's policy descends.
    pub policy_loss: Option<f64>,
    /// Mean of what its value descends.
    pub value_loss: Option<f64>,
    /// Mean divergence from the policy that acted.
    pub approx_kl: Option<f64>,
    /// Share of steps beyond the clip.
    pub clip_fraction: Option<f64>,
    /// Training episodes that ended.
    pub episodes: u64,
    /// Mean of their returns.
    pub return_mean: Option<f64>,
    /// Share of successes among those that say whether they succeeded.
    pub success_rate: Option<f64>,
    /// Median and largest policy lag.
    pub lag: Option<(u64, u64)>,
}

impl Collector {
    /// For `workers * envs_per_worker` environments.
    #[must_use]
    pub fn new(layout: SegmentLayout, workers: usize, envs_per_worker: usize) -> Self {
        let envs = workers * envs_per_worker;
        Self {
            layout,
            envs_per_worker,
            returns: vec![0.0; envs],
            whole: vec![false; envs],
            window: Sums::default(),
            lags: Vec::with_capacity(LAGS_MAX),
            lag_next: 0,
        }
    }

    /// Books an update.
    pub fn updated(&mut self, losses: Losses) {
        self.window.critic_loss.add(losses.critic_loss);
        self.window.actor_loss.add(losses.actor_loss);
        self.window.q_mean.add(losses.q_mean);
        self.window.temperature.add(losses.temperature);
        self.window.entropy.add(losses.entropy);
    }

    /// Books an update of an on-policy algorithm.
    pub fn updated_on_policy(&mut self, losses: NdpLosses) {
        self.window.policy_loss.add(losses.policy_loss);
        self.window.value_loss.add(losses.value_loss);
        self.window.entropy.add(losses.entropy);
        self.window.approx_kl.add(losses.approx_kl);
        self.window.clip_fraction.add(losses.clip_fraction);
    }

    /// Books an inserted segment; `newest` is the newest policy's version.
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
                self.window.judged += u64::from(header.flags & SUCCESS_REPORTED != 0);
                self.window.successes += u64::from(header.flags & SUCCESS != 0);
            }
            self.whole[env] = false;
        }
    }

    /// Closes the window and opens the next.
    pub fn take(&mut self) -> Collected {
        let window = std::mem::take(&mut self.window);
        let episodes = window.episodes as f64;
        self.lags.sort_unstable();
        let lag = (!self.lags.is_empty()).then(|| (self.lags[self.lags.len() / 2], window.lag_max));
        self.lags.clear();
        self.lag_next = 0;
        Collected {
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
            success_rate: (window.judged > 0)
                .then(|| window.successes as f64 / window.judged as f64),
            lag,
        }
    }
}
