//! The learner's state and its operations: insert a segment, update, publish.
//!
//! It reads no clock and uses no transport, and no file except the segment log that it is given.
//! The loop around it ([`crate::session`]) provides these.

mod arrival;
mod average;

use std::borrow::Cow;

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::Policy;
use dmprl_shared::seeds;
use dmprl_shared::segment::Expected;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{Inbox, Sent};
use serde::{Deserialize, Serialize};

use crate::algorithms::SampleSource;
use crate::algorithms::ndp::UpdateContext;
use crate::demonstrations::Demonstration;
use crate::finite;
use crate::metrics::{DeliveryLine, MetricsCollector, MetricsLine, Rejected};
use crate::normaliser::{Normaliser, RelativeGoal};
use crate::off_policy::{CloningLosses, UpdateProgress};
use crate::regime::Regime;
use crate::replay::{GoalSampler, JerkCost, Replay, Sampler};
use crate::update::network::TrainableNetwork;

pub use crate::error::LearnerError;
pub use arrival::InsertObserver;
pub use average::PolicyAverage;

/// Progress of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counters {
    /// Environment steps inserted.
    pub env_steps: u64,
    /// Segments inserted.
    pub segments: u64,
    /// Hindsight copies inserted. Checkpoints of older versions do not have this field.
    #[serde(default)]
    pub hindsight_segments: u64,
    /// Updates done.
    pub updates: u64,
    /// Version of the newest published policy.
    pub policy_version: u64,
    /// Segments rejected, by reason.
    pub rejected: Rejected,
    /// Segments missing in the workers' sequences.
    pub lost: u64,
    /// Segments received, including rejected ones. Checkpoints of older versions do not have this
    /// field.
    #[serde(default)]
    pub received: u64,
    /// Bytes of incomplete records cut off the end of the segment log. Checkpoints of older
    /// versions do not have this field.
    #[serde(default)]
    pub log_bytes_cut: u64,
    /// Segments that an on-policy algorithm did not learn from, because an older policy had made
    /// them. Checkpoints of older versions do not have this field.
    #[serde(default)]
    pub stale_segments: u64,
    /// Failures of environments, reported by workers and evaluator. Stored here for the run's later
    /// sessions. Checkpoints of older versions do not have this field.
    #[serde(default)]
    pub env_failures: u64,
    /// Segments sent, as reported by the workers. Stored here for the run's later sessions.
    #[serde(default)]
    pub sent: Sent,
    /// Restarts of the learner after a crash. Stored here for the run's later sessions.
    #[serde(default)]
    pub learner_restarts: u64,
    /// Restarts of workers after a crash. Stored here for the run's later sessions.
    #[serde(default)]
    pub worker_restarts: u64,
}

/// The state of a learner.
#[derive(Debug)]
pub struct Learner {
    config: ExperimentConfig,
    policy: Policy,
    expected: Expected,
    /// The algorithm, off-policy or on-policy, with its networks and optimisers.
    pub regime: Regime,
    /// Experience of off-policy algorithms.
    pub replay: Replay,
    /// Draws windows from the replay. Its random stream also serves on-policy algorithms.
    pub sampler: Sampler,
    /// Draws goals for windows, if hindsight is configured and the environment has a goal rule.
    pub hindsight: Option<GoalSampler>,
    /// Cost of jerk, if it is configured.
    pub jerk_cost: Option<JerkCost>,
    /// Observation normalisation, if it is configured.
    pub normaliser: Option<Normaliser>,
    /// Progress of the run.
    pub counters: Counters,
    /// The average of the newest policies, if it is configured.
    pub average: Option<PolicyAverage>,
    collector: MetricsCollector,
    snapshot: ParameterSnapshot,
    /// Newest sequence number of each worker, with the segment log.
    pub inbox: Inbox,
    /// Called for every segment, if set.
    pub insert_observer: InsertObserver,
}

impl Learner {
    /// Makes a learner without experience.
    ///
    /// # Errors
    /// If the policy does not fit the environment.
    pub fn new(
        config: ExperimentConfig,
        spec: &EnvSpec,
        run_id: u64,
    ) -> Result<Self, LearnerError> {
        let policy = Policy::new(config.policy_description(spec))?;
        let (workers, envs) = (config.places(), config.actors.envs_per_worker);
        let layout = policy.layout();
        let regime = Regime::new(&config, &policy, spec.goal_rule.as_deref())?;
        let random = seeds::stream(config.run.seed, "replay", 0);
        let hindsight = GoalSampler::from_config(spec.goal_rule.as_deref(), &config);
        let jerk_cost = JerkCost::from_config(&config, spec)?;
        let replay_steps = regime.replay_steps(&config, layout.segment_steps);
        Ok(Self {
            expected: Expected {
                run_id,
                architecture_hash: policy.architecture_hash(),
                layout,
                action_bounds: policy.action_bounds(),
                worker_count: workers as u32,
                env_count: envs as u32,
            },
            replay: Replay::new(layout, replay_steps, workers, envs),
            sampler: Sampler::new(config.algorithm.windows, random)
                .with_demonstrated(config.demonstrations.share),
            normaliser: config.policy.normalise_observations.then(|| {
                // The first update follows the warm-up; then each doubling of the observations.
                let relative = hindsight.as_ref().map(|goals| RelativeGoal::new(&goals.rule));
                let first = config.exploration.warm_up_steps;
                Normaliser::new(layout.observation_len, first, relative)
            }),
            hindsight,
            jerk_cost,
            average: (config.learner.average_share > 0.0)
                .then(|| PolicyAverage::new(config.learner.average_share)),
            counters: Counters::default(),
            collector: MetricsCollector::new(layout, workers, envs),
            snapshot: ParameterSnapshot {
                architecture_hash: policy.architecture_hash(),
                values: vec![0.0; policy.parameters_len()],
                ..ParameterSnapshot::default()
            },
            inbox: Inbox::new(workers),
            insert_observer: InsertObserver::default(),
            regime,
            policy,
            config,
        })
    }

    /// Returns the experiment's configuration.
    #[must_use]
    pub fn config(&self) -> &ExperimentConfig {
        &self.config
    }

    /// Returns the policy's architecture.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// Returns whether the run has all its environment steps.
    #[must_use]
    pub fn has_all_steps(&self) -> bool {
        self.counters.env_steps >= self.config.run.steps
    }

    /// Returns whether the learner may take a segment now.
    #[must_use]
    pub fn may_take(&self) -> bool {
        self.regime.may_take() && !self.has_all_steps() && self.inbox.has_room()
    }

    /// Returns whether an update is due.
    #[must_use]
    pub fn update_due(&self) -> bool {
        self.regime.update_due()
    }

    /// Returns true if the policy must be published, `updates` updates after the last publication.
    #[must_use]
    pub fn publish_due(&self, updates: u64) -> bool {
        self.regime.publish_due(updates, self.config.learner.publish_every_updates)
    }

    /// Does one update of the networks.
    ///
    /// # Errors
    /// If there is nothing to sample, a device operation fails or a loss is not finite.
    pub fn update(&mut self) -> Result<(), LearnerError> {
        if self.normaliser.as_ref().is_some_and(Normaliser::is_due) {
            self.update_normaliser()?;
        }
        if let Some(hindsight) = &mut self.hindsight {
            hindsight.read_recent(&self.replay);
        }
        let Self { config, policy, regime, replay, sampler, counters, .. } = self;
        match regime {
            Regime::OffPolicy(off_policy) => {
                let source = SampleSource {
                    replay,
                    sampler,
                    hindsight: self.hindsight.as_ref(),
                    jerk_cost: self.jerk_cost.as_ref(),
                    normaliser: self.normaliser.as_ref(),
                };
                let (update, env_steps) = (counters.updates + 1, counters.env_steps);
                let progress = UpdateProgress { update, env_steps };
                let losses = off_policy.update(config, policy, source, progress)?;
                let named =
                    [("critic_loss", Some(losses.critic_loss)), ("actor_loss", losses.actor_loss)];
                self.count_update(named)?;
                self.collector.updated(losses);
            }
            Regime::OnPolicy(ndp) => {
                let progress = counters.env_steps as f64 / config.run.steps as f64;
                let normaliser = self.normaliser.as_ref();
                let context = UpdateContext { policy, normaliser, progress };
                let losses = ndp.update(context, sampler.random_mut());
                let named = [
                    ("policy_loss", Some(losses.policy_loss)),
                    ("value_loss", Some(losses.value_loss)),
                ];
                self.count_update(named)?;
                self.collector.updated_on_policy(losses);
            }
        }
        self.average_policy()
    }

    /// Adds the policy to the average if it is due.
    fn average_policy(&mut self) -> Result<(), LearnerError> {
        let updates = self.counters.updates;
        if let Some(average) = &mut self.average
            && PolicyAverage::is_due(updates)
        {
            let newest = average.newest_mut(self.policy.parameters_len());
            read_policy(&self.regime, self.normaliser.as_ref(), &self.policy, newest)?;
            average.add(updates);
        }
        Ok(())
    }

    /// Counts an update, if its losses are finite.
    fn count_update(
        &mut self,
        losses: [(&'static str, Option<f32>); 2],
    ) -> Result<(), LearnerError> {
        for (name, value) in losses {
            let Some(value) = value else { continue };
            if !value.is_finite() {
                return Err(LearnerError::NotFinite { update: self.counters.updates, name, value });
            }
        }
        self.counters.updates += 1;
        Ok(())
    }

    /// Updates mean and scale of the observations, and rewrites all networks to match.
    fn update_normaliser(&mut self) -> Result<(), LearnerError> {
        if let Some(normaliser) = &mut self.normaliser {
            let change = normaliser.update();
            self.regime.fetch()?;
            let has_observations = |name: &str| !name.starts_with("log_");
            self.for_each_network(|name, network| {
                if has_observations(name) {
                    change.apply(network);
                }
                Ok::<(), LearnerError>(())
            })?;
        }
        Ok(())
    }

    /// Adds demonstrations to the replay. If configured, the actor imitates them for
    /// `demonstrations.cloning_updates` updates; returns the losses of these.
    ///
    /// # Errors
    /// If the demonstrations do not fit into the replay, or have no whole window.
    pub fn demonstrate(
        &mut self,
        demonstrations: &[Demonstration],
    ) -> Result<Option<CloningLosses>, LearnerError> {
        for demonstration in demonstrations {
            demonstration.insert_into(&mut self.replay)?;
            if let Some(normaliser) = &mut self.normaliser {
                normaliser.observe(&demonstration.observations);
                if let Some(goals) = &self.hindsight {
                    normaliser.observe_relabelled(&demonstration.observations, &goals.rule);
                }
            }
        }
        self.update_normaliser()?;
        let Self { config, policy, regime, replay, sampler, .. } = self;
        let normaliser = self.normaliser.as_ref();
        let source = SampleSource { replay, sampler, hindsight: None, jerk_cost: None, normaliser };
        match regime {
            Regime::OffPolicy(off_policy) => {
                let updates = config.demonstrations.cloning_updates;
                off_policy.clone_demonstrations(policy, source, updates)
            }
            Regime::OnPolicy(_) => Ok(None),
        }
    }

    /// Calls `f` with every network and its name in a checkpoint. `f` may change the network.
    ///
    /// # Errors
    /// The first error that `f` returns.
    pub fn for_each_network<E>(
        &mut self,
        f: impl FnMut(&'static str, &mut TrainableNetwork) -> Result<(), E>,
    ) -> Result<(), E> {
        self.regime.for_each_network(f)
    }

    /// Returns every network with its name in a checkpoint.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &TrainableNetwork)> {
        self.regime.networks()
    }

    /// Makes a snapshot of the policy under the next version.
    ///
    /// # Errors
    /// If a device operation fails, or a parameter of the policy is not finite.
    pub fn next_snapshot(&mut self) -> Result<&ParameterSnapshot, LearnerError> {
        self.counters.policy_version += 1;
        self.snapshot.version = self.counters.policy_version;
        self.snapshot.env_steps = self.counters.env_steps;
        if let Some(hindsight) = &mut self.hindsight {
            // Also before the first update after a resume.
            hindsight.read_recent(&self.replay);
            self.snapshot.settled = hindsight.is_settled();
        }
        let updates = self.counters.updates;
        let values = &mut self.snapshot.values;
        match self.average.as_ref().and_then(|average| average.newest(updates)) {
            // A policy on a GPU is copied once.
            Some(newest) => values.copy_from_slice(newest),
            None => read_policy(&self.regime, self.normaliser.as_ref(), &self.policy, values)?,
        }
        finite::check(&self.snapshot.values, || "policy".to_owned())
            .map_err(|source| LearnerError::NotFiniteParameter { update: updates, source })?;
        self.regime.policy_published(self.snapshot.version);
        Ok(&self.snapshot)
    }

    /// Returns the policy that is saved and evaluated under the newest version: the average, if it
    /// is configured.
    #[must_use]
    pub fn saved_snapshot(&self) -> Cow<'_, ParameterSnapshot> {
        let average = self.average.as_ref().map_or(&[][..], PolicyAverage::values);
        if average.is_empty() {
            return Cow::Borrowed(&self.snapshot);
        }
        Cow::Owned(ParameterSnapshot { values: average.to_vec(), ..self.snapshot })
    }

    /// Sets the actor and its target to the parameters of another policy.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn warm_start(&mut self, parameters: &[f32]) -> Result<(), LearnerError> {
        let mut parameters = parameters.to_vec();
        let fits = parameters.len() == self.policy.parameters_len();
        if let Some(normaliser) = self.normaliser.as_ref().filter(|_| fits) {
            normaliser.unfold(self.policy.shape(), &mut parameters);
        }
        Ok(self.regime.set_policy(&parameters)?)
    }

    /// Returns updates * samples per update / env_steps.
    #[must_use]
    pub fn samples_per_insert(&self) -> f64 {
        let samples = self.counters.updates as f64 * self.regime.samples_per_update() as f64;
        samples / (self.counters.env_steps.max(1) as f64)
    }

    /// Returns the metrics since the last call. The caller fills the fields that depend on time or
    /// on the supervisor.
    pub fn metrics_line(&mut self) -> MetricsLine {
        let collected = self.collector.take();
        let counters = self.counters;
        MetricsLine {
            env_steps: counters.env_steps,
            updates: counters.updates,
            segments: counters.segments,
            hindsight_segments: counters.hindsight_segments,
            policy_version: counters.policy_version,
            replay_segments: self.regime.segments_held(&self.replay) as u64,
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
            policy_lag_p50: collected.lag.map(|lag| lag.median),
            policy_lag_max: collected.lag.map(|lag| lag.max),
            updates_owed: self.regime.updates_owed(),
            workers: 0,
            queued_segments: 0,
            worker_restarts: counters.worker_restarts,
            wall_s: 0.0,
            env_steps_per_s: 0.0,
            updates_per_s: 0.0,
        }
    }
}

/// Reads the parameters of the policy for plain observations, (P,).
fn read_policy(
    regime: &Regime,
    normaliser: Option<&Normaliser>,
    policy: &Policy,
    values: &mut [f32],
) -> Result<(), LearnerError> {
    regime.read_policy(values)?;
    if let Some(normaliser) = normaliser {
        normaliser.fold(policy.shape(), values);
    }
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests;
