//! The learner's state and its three moves: take a segment, update, publish.
//!
//! No clock and no transport here, and no file but the segment log it is handed: the loop around it
//! (`session`) brings those.

mod arrival;
mod imitation;

use dmprl_shared::config::{AlgorithmName, ExperimentConfig};
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::{Head, Policy, PolicyError};
use dmprl_shared::seeds;
use dmprl_shared::segment::{Expected, SegmentLayout};
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{Inbox, Sent};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::algorithms::cloning::Cloning;
use crate::algorithms::ndp::{Ndp, Scene};
use crate::algorithms::{Algorithm, Batch, NoWindow};
use crate::demonstrations::DemonstrationError;
use crate::metrics::{Collector, DeliveryLine, MetricsLine, Rejected};
use crate::normaliser::Normaliser;
use crate::pacing::Pacing;
use crate::replay::{Replay, Sampler};
use crate::rollout_buffer::RolloutBuffer;
use crate::update::trained::Trained;

pub use arrival::Witness;

/// Why the learner stopped.
#[derive(Debug, Error)]
pub enum LearnerError {
    /// The policy cannot be built.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A tensor operation failed.
    #[error("tensor operation: {0}")]
    Tensor(#[from] candle_core::Error),
    /// The replay has nothing to learn from.
    #[error(transparent)]
    NoWindow(#[from] NoWindow),
    /// Demonstrations do not fit.
    #[error(transparent)]
    Demonstrations(#[from] DemonstrationError),
    /// A loss or parameter is NaN or infinite.
    #[error(
        "update {update}: {name} is {value}; the run has diverged. The last checkpoint is sound: \
         lower algorithm.critic_learning_rate or pacing.updates_per_segment"
    )]
    NotFinite {
        /// Which update.
        update: u64,
        /// Which quantity.
        name: &'static str,
        /// Its value.
        value: f32,
    },
}

/// Where a run stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counters {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Segments inserted.
    pub segments: u64,
    /// Copies of segments with other goals inserted. Checkpoints of older versions have none.
    #[serde(default)]
    pub hindsight_segments: u64,
    /// Updates done.
    pub updates: u64,
    /// Version of the newest published policy.
    pub policy_version: u64,
    /// Segments refused, by reason.
    pub rejected: Rejected,
    /// Segments missing in the workers' sequences.
    pub lost: u64,
    /// Segments that came, refused ones included. Checkpoints of older versions have none.
    #[serde(default)]
    pub received: u64,
    /// Bytes behind the last whole record of the segment log, cut off. Checkpoints of older
    /// versions have none.
    #[serde(default)]
    pub log_bytes_cut: u64,
    /// Segments that an on-policy algorithm did not learn from, since another policy had made
    /// them. Checkpoints of older versions have none.
    #[serde(default)]
    pub stale_segments: u64,
    /// Failures of environments, as workers and evaluator reported them: counted elsewhere, kept
    /// here for the run's later sessions. Checkpoints of older versions have none.
    #[serde(default)]
    pub env_failures: u64,
    /// What the workers did, as they reported it, likewise.
    #[serde(default)]
    pub sent: Sent,
    /// Starts of the learner after a death within a session, likewise.
    #[serde(default)]
    pub learner_restarts: u64,
    /// Starts of workers after a death, likewise.
    #[serde(default)]
    pub worker_restarts: u64,
}

/// Everything that learns.
#[derive(Debug)]
pub struct Learner {
    config: ExperimentConfig,
    policy: Policy,
    expected: Expected,
    /// Networks and optimisers.
    pub algorithm: Algorithm,
    /// Experience.
    pub replay: Replay,
    /// Draws batches.
    pub sampler: Sampler,
    /// Observation normalisation, if it is asked for.
    pub normaliser: Option<Normaliser>,
    /// Updates owed.
    pub pacing: Pacing,
    /// Where the run stands.
    pub counters: Counters,
    batch: Batch,
    collector: Collector,
    snapshot: ParameterSnapshot,
    /// How far each worker's segments have come.
    pub inbox: Inbox,
    /// Who else is told of what comes.
    pub witness: Witness,
    omega: f32,
    /// Where the policy imitates demonstrations.
    cloning: Option<Cloning>,
}

impl Learner {
    /// A learner that has seen nothing.
    ///
    /// # Errors
    /// If the policy does not fit the environment.
    pub fn new(
        config: ExperimentConfig,
        spec: &EnvSpec,
        run_id: u64,
    ) -> Result<Self, LearnerError> {
        let policy = Policy::new(&config, spec)?;
        let (workers, envs) = (config.places(), config.actors.envs_per_worker);
        let layout = policy.layout();
        let algorithm = Algorithm::new(&config, &policy)?;
        let random = seeds::stream(config.run.seed, "replay", 0);
        Ok(Self {
            expected: Expected {
                run_id,
                architecture_hash: policy.architecture_hash(),
                layout,
                action_bounds: policy.action_bounds(),
                worker_count: workers as u32,
                env_count: envs as u32,
            },
            replay: Replay::new(layout, replay_steps(&config, layout), workers, envs),
            sampler: Sampler::new(config.algorithm.windows, random),
            normaliser: config.policy.normalise_observations.then(|| {
                // Nothing is learned before; afterwards they are taken anew at each doubling.
                Normaliser::new(layout.observation_len, config.exploration.warm_up_steps)
            }),
            pacing: Pacing::new(&config.pacing),
            counters: Counters::default(),
            batch: Batch::new(algorithm.batch_shape()),
            collector: Collector::new(layout, workers, envs),
            snapshot: ParameterSnapshot {
                architecture_hash: policy.architecture_hash(),
                values: vec![0.0; policy.parameters_len()],
                ..ParameterSnapshot::default()
            },
            inbox: Inbox::new(workers),
            witness: Witness::default(),
            cloning: match config.demonstrations.are_cloned() {
                true => Some(Cloning::new(&config, &policy)?),
                false => None,
            },
            omega: match policy.head() {
                Head::Dmp(head) => head.omega(),
                Head::Mlp => 1.0,
            },
            algorithm,
            policy,
            config,
        })
    }

    /// The experiment.
    #[must_use]
    pub fn config(&self) -> &ExperimentConfig {
        &self.config
    }

    /// The policy's architecture.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// Whether the run has the environment steps it was asked for.
    #[must_use]
    pub fn has_all_steps(&self) -> bool {
        self.counters.env_steps >= self.config.run.steps
    }

    /// Whether the learner wants a segment now.
    #[must_use]
    pub fn may_take(&self) -> bool {
        let ready = match self.algorithm.as_on_policy() {
            Some(ndp) => !ndp.update_due(),
            None => self.pacing.may_take(),
        };
        ready && !self.has_all_steps() && self.inbox.has_room()
    }

    /// Whether an update is to be done now.
    #[must_use]
    pub fn update_due(&self) -> bool {
        match self.algorithm.as_on_policy() {
            Some(ndp) => ndp.update_due(),
            None => self.pacing.update_due(),
        }
    }

    /// Whether the policy is to be published after `updates` updates since the last time.
    #[must_use]
    pub fn publish_due(&self, updates: u64) -> bool {
        match self.algorithm.as_on_policy() {
            // At the end of its rollout, and at once: until then whatever comes is stale.
            Some(ndp) => !ndp.update_due(),
            None => updates >= self.config.learner.publish_every_updates,
        }
    }

    /// Samples a batch and updates the networks.
    ///
    /// # Errors
    /// If there is nothing to sample or a loss is not finite.
    pub fn update(&mut self) -> Result<(), LearnerError> {
        self.refresh_normaliser()?;
        let normaliser = self.normaliser.as_ref();
        if let Some((ndp, crew)) = self.algorithm.on_policy() {
            let progress = self.counters.env_steps as f64 / self.config.run.steps as f64;
            let scene = Scene { policy: &self.policy, crew, normaliser, progress };
            let losses = ndp.update(scene, self.sampler.random_mut());
            let named = [("policy_loss", losses.policy_loss), ("value_loss", losses.value_loss)];
            self.updated(named.map(|(name, value)| (name, Some(value))))?;
            self.collector.updated_on_policy(losses);
            return Ok(());
        }
        let source = (&self.replay, &mut self.sampler);
        let shape = self.algorithm.batch_shape();
        self.batch.sample(shape, &self.config.algorithm, self.omega, normaliser, source)?;
        let losses = self.update_networks()?;
        self.updated([
            ("critic_loss", Some(losses.critic_loss)),
            ("actor_loss", losses.actor_loss),
        ])?;
        self.pacing.updated();
        self.collector.updated(losses);
        Ok(())
    }

    /// Counts an update whose losses are finite.
    fn updated(&mut self, losses: [(&'static str, Option<f32>); 2]) -> Result<(), LearnerError> {
        for (name, value) in losses {
            let Some(value) = value else { continue };
            if !value.is_finite() {
                return Err(LearnerError::NotFinite { update: self.counters.updates, name, value });
            }
        }
        self.counters.updates += 1;
        Ok(())
    }

    fn refresh_normaliser(&mut self) -> Result<(), LearnerError> {
        match &self.normaliser {
            Some(normaliser) if normaliser.is_due() => self.take_normaliser_anew(),
            _ => Ok(()),
        }
    }

    fn take_normaliser_anew(&mut self) -> Result<(), LearnerError> {
        if let Some(normaliser) = &mut self.normaliser {
            let change = normaliser.refresh();
            self.algorithm.fetch()?;
            let sees_observations = |name: &str| !name.starts_with("log_");
            self.each_network(|name, trained| {
                if sees_observations(name) { change.apply(trained) } else { Ok(()) }
            })?;
        }
        Ok(())
    }

    /// Hands every network, with the name it has in a checkpoint, to `f`, which may change it.
    ///
    /// # Errors
    /// The first that `f` returns.
    pub fn each_network<E>(
        &mut self,
        mut f: impl FnMut(&'static str, &mut Trained) -> Result<(), E>,
    ) -> Result<(), E> {
        self.algorithm.each_network(&mut f)?;
        self.cloning.as_mut().map_or(Ok(()), |cloning| f("cloning", &mut cloning.actor))
    }

    /// As [`Learner::each_network`], to read them.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &Trained)> {
        let cloning = self.cloning.iter().map(|cloning| ("cloning", &cloning.actor));
        self.algorithm.networks().into_iter().chain(cloning).collect()
    }

    /// A snapshot of the actor under the next version.
    ///
    /// # Errors
    /// If the parameters cannot be read.
    pub fn next_snapshot(&mut self) -> Result<&ParameterSnapshot, LearnerError> {
        self.counters.policy_version += 1;
        self.snapshot.version = self.counters.policy_version;
        self.snapshot.env_steps = self.counters.env_steps;
        self.algorithm.read_policy(&mut self.snapshot.values)?;
        if let Some(normaliser) = &self.normaliser {
            normaliser.fold(self.policy.shape(), &mut self.snapshot.values);
        }
        if let Some((ndp, _)) = self.algorithm.on_policy() {
            ndp.published(self.snapshot.version);
        }
        Ok(&self.snapshot)
    }

    /// The snapshot that [`Learner::next_snapshot`] made last.
    #[must_use]
    pub fn snapshot(&self) -> &ParameterSnapshot {
        &self.snapshot
    }

    /// Starts the actor and its target from another policy's parameters.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn warm_start(&mut self, parameters: &[f32]) -> Result<(), LearnerError> {
        Ok(self.algorithm.set_policy(parameters)?)
    }

    /// updates * batch_size / env_steps; on-policy, segments of a minibatch for batch_size.
    #[must_use]
    pub fn samples_per_insert(&self) -> f64 {
        let minibatch = self.algorithm.as_on_policy().map(Ndp::minibatch);
        let batch = minibatch.unwrap_or(self.config.algorithm.batch_size);
        let samples = self.counters.updates as f64 * batch as f64;
        samples / (self.counters.env_steps.max(1) as f64)
    }

    /// Closes the metrics window; the time fields are the caller's.
    pub fn metrics_line(&mut self) -> MetricsLine {
        let collected = self.collector.take();
        let counters = self.counters;
        let rollout = self.algorithm.as_on_policy().map(|ndp| &ndp.rollout);
        MetricsLine {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            hindsight_segments: counters.hindsight_segments,
            policy_version: counters.policy_version,
            replay_segments: rollout.map_or(self.replay.len(), RolloutBuffer::len) as u64,
            samples_per_insert: self.samples_per_insert(),
            rejected: counters.rejected,
            lost: counters.lost,
            delivery: DeliveryLine {
                produced: counters.sent.produced,
                sent: counters.sent.sent,
                resent: counters.sent.resent,
                acked: counters.sent.acked,
                received: counters.received,
                log_bytes_cut: counters.log_bytes_cut,
            },
            learner_restarts: counters.learner_restarts,
            stale_segments: counters.stale_segments,
            env_failures: counters.env_failures,
            critic_loss: collected.critic_loss,
            actor_loss: collected.actor_loss,
            q_mean: collected.q_mean,
            temperature: collected.temperature,
            entropy: collected.entropy,
            policy_loss: collected.policy_loss,
            value_loss: collected.value_loss,
            approx_kl: collected.approx_kl,
            clip_fraction: collected.clip_fraction,
            episodes: collected.episodes,
            training_return_mean: collected.return_mean,
            training_success_rate: collected.success_rate,
            policy_lag_p50: collected.lag.map(|lag| lag.0),
            policy_lag_max: collected.lag.map(|lag| lag.1),
            updates_owed: self.pacing.owed(),
            workers: 0,
            queued_segments: 0,
            worker_restarts: counters.worker_restarts,
            wall_s: 0.0,
            env_steps_per_s: 0.0,
            updates_per_s: 0.0,
        }
    }
}

/// Room of the replay: an on-policy algorithm keeps its own experience and needs none.
fn replay_steps(config: &ExperimentConfig, layout: SegmentLayout) -> usize {
    match config.algorithm.name {
        AlgorithmName::Ndp => layout.segment_steps,
        _ => config.replay.capacity_steps,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn spec() -> EnvSpec {
        EnvSpec {
            id: "Test-v0".into(),
            observation_len: 4,
            action_len: 2,
            action_low: vec![-1.0; 2],
            action_high: vec![1.0; 2],
            control_dt_s: 0.02,
            episode_steps: 10,
            observation_names: Vec::new(),
        }
    }
}
