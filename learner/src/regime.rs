//! Off-policy or on-policy: decides where segments are stored, when updates are due and when
//! policies are published. Called by [`crate::learner`].

use candle_core::Result;
use dmprl_shared::config::{AlgorithmName, ExperimentConfig};
use dmprl_shared::goal_rule::GoalRule;
use dmprl_shared::policy::Policy;

use crate::algorithms::ndp::Ndp;
use crate::off_policy::OffPolicy;
use crate::replay::Replay;
use crate::update::network::TrainableNetwork;

/// How an algorithm uses the segments of its workers.
#[derive(Debug)]
pub enum Regime {
    /// Samples batches from a replay with the segments of all policies. Each segment adds to the
    /// updates that are owed.
    OffPolicy(Box<OffPolicy>),
    /// Fills a rollout with segments of the newest policy, learns from it and discards it.
    OnPolicy(Box<Ndp>),
}

impl Regime {
    /// Makes the configured algorithm with newly drawn networks. `rule` is the environment's rule
    /// for goals, if it has one.
    ///
    /// # Errors
    /// If the processor or the device does not support the configuration.
    pub fn new(
        config: &ExperimentConfig,
        policy: &Policy,
        rule: Option<&GoalRule>,
    ) -> Result<Self> {
        Ok(match config.algorithm.name {
            AlgorithmName::Ndp => Self::OnPolicy(Box::new(Ndp::new(config, policy)?)),
            _ => Self::OffPolicy(Box::new(OffPolicy::new(config, policy, rule)?)),
        })
    }

    /// Returns the capacity of the replay in environment steps. An on-policy algorithm needs none,
    /// so it gets the minimum of one segment.
    #[must_use]
    pub fn replay_steps(&self, config: &ExperimentConfig, segment_steps: usize) -> usize {
        match self {
            Self::OffPolicy(_) => config.replay.capacity_steps,
            Self::OnPolicy(_) => segment_steps,
        }
    }

    /// Returns whether the next segment may be taken before the next update.
    #[must_use]
    pub fn may_take(&self) -> bool {
        match self {
            Self::OffPolicy(off_policy) => off_policy.pacing.may_take(),
            Self::OnPolicy(ndp) => !ndp.update_due(),
        }
    }

    /// Returns whether an update is due.
    #[must_use]
    pub fn update_due(&self) -> bool {
        match self {
            Self::OffPolicy(off_policy) => off_policy.pacing.update_due(),
            Self::OnPolicy(ndp) => ndp.update_due(),
        }
    }

    /// Returns true if the policy must be published, `updates` updates after the last publication.
    #[must_use]
    pub fn publish_due(&self, updates: u64, publish_every_updates: u64) -> bool {
        match self {
            Self::OffPolicy(_) => updates >= publish_every_updates,
            // At once after the last update of a rollout, because segments are stale until then.
            Self::OnPolicy(ndp) => !ndp.update_due(),
        }
    }

    /// Takes note of the version under which the policy was published.
    pub fn policy_published(&mut self, version: u64) {
        match self {
            Self::OffPolicy(_) => {}
            Self::OnPolicy(ndp) => ndp.policy_published(version),
        }
    }

    /// Returns the samples of one update: windows of a batch, or segments of a minibatch.
    #[must_use]
    pub fn samples_per_update(&self) -> usize {
        match self {
            Self::OffPolicy(off_policy) => off_policy.algorithm.batch_shape().rows,
            Self::OnPolicy(ndp) => ndp.minibatch(),
        }
    }

    /// Returns the number of segments that updates can learn from now.
    #[must_use]
    pub fn segments_held(&self, replay: &Replay) -> usize {
        match self {
            Self::OffPolicy(_) => replay.len(),
            Self::OnPolicy(ndp) => ndp.rollout.len(),
        }
    }

    /// Returns the updates owed, fractions included. An on-policy algorithm owes none.
    #[must_use]
    pub fn updates_owed(&self) -> f64 {
        match self {
            Self::OffPolicy(off_policy) => off_policy.pacing.owed(),
            Self::OnPolicy(_) => 0.0,
        }
    }

    /// Restores the updates owed from a checkpoint.
    pub fn restore_updates_owed(&mut self, owed: f64) {
        match self {
            Self::OffPolicy(off_policy) => off_policy.pacing.restore(owed),
            Self::OnPolicy(_) => {}
        }
    }

    /// Copies the networks back from another device, if updates run there. Call it before reading
    /// networks.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn fetch(&mut self) -> Result<()> {
        match self {
            Self::OffPolicy(off_policy) => off_policy.algorithm.fetch(),
            Self::OnPolicy(_) => Ok(()),
        }
    }

    /// Copies the policy's flat parameters, (P,), from the device that updates them.
    ///
    /// # Errors
    /// If a device operation fails.
    pub fn read_policy(&self, values: &mut [f32]) -> Result<()> {
        match self {
            Self::OffPolicy(off_policy) => off_policy.algorithm.read_policy(values),
            Self::OnPolicy(ndp) => {
                ndp.read_policy(values);
                Ok(())
            }
        }
    }

    /// Sets the actor, and its target if it has one, to the parameters of another policy.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set_policy(&mut self, values: &[f32]) -> Result<()> {
        match self {
            Self::OffPolicy(off_policy) => off_policy.algorithm.set_policy(values),
            Self::OnPolicy(ndp) => ndp.set_policy(values),
        }
    }

    /// Calls `f` with every network and its name in a checkpoint. `f` may change the network.
    ///
    /// # Errors
    /// The first error that `f` returns.
    pub fn for_each_network<E>(
        &mut self,
        f: impl FnMut(&'static str, &mut TrainableNetwork) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        match self {
            Self::OffPolicy(off_policy) => off_policy.for_each_network(f),
            Self::OnPolicy(ndp) => ndp.for_each_network(f),
        }
    }

    /// Returns every network with its name in a checkpoint.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &TrainableNetwork)> {
        match self {
            Self::OffPolicy(off_policy) => off_policy.networks(),
            Self::OnPolicy(ndp) => ndp.networks(),
        }
    }
}
