//! Stages 5 and 6 of 8 for off-policy algorithms: each segment adds to the updates owed, and an
//! update samples a batch from the replay. With demonstrations, the actor imitates them before and
//! beside these updates. Called by [`crate::learner`].

mod next_batch;

use dmprl_shared::config::{Device, ExperimentConfig};
use dmprl_shared::goal_rule::GoalRule;
use dmprl_shared::policy::{Head, Policy};

use crate::algorithms::cloning::Cloning;
use crate::algorithms::{Algorithm, Batch, Losses, SampleSource};
use crate::error::LearnerError;
use crate::pacing::Pacing;
use crate::replay::Sampler;
use crate::update::network::TrainableNetwork;
use next_batch::NextBatch;

/// An off-policy algorithm with the pacing of its updates.
#[derive(Debug)]
pub struct OffPolicy {
    /// Networks and optimisers.
    pub algorithm: Algorithm,
    /// Account of the updates owed.
    pub pacing: Pacing,
    batch: Batch,
    /// On a GPU.
    next_batch: Option<NextBatch>,
    omega: f32,
    /// Imitation of demonstrations, if it is configured.
    cloning: Option<Cloning>,
}

/// Progress of the run at an update.
#[derive(Debug, Clone, Copy)]
pub struct UpdateProgress {
    /// Number of the update, counted from 1.
    pub update: u64,
    /// Environment steps inserted so far.
    pub env_steps: u64,
}

/// Mean losses of an actor that imitated demonstrations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CloningLosses {
    /// Mean over the first tenth of the updates.
    pub first: f32,
    /// Mean over the last tenth of the updates.
    pub last: f32,
}

impl OffPolicy {
    /// Makes the configured algorithm with newly drawn networks. `rule` is the environment's rule
    /// for goals, if it has one.
    ///
    /// # Errors
    /// If the processor or the device does not support the configuration.
    pub fn new(
        config: &ExperimentConfig,
        policy: &Policy,
        rule: Option<&GoalRule>,
    ) -> candle_core::Result<Self> {
        let algorithm = Algorithm::new(config, policy, rule)?;
        // On the CPU, another thread would take a core from the update. A deterministic run must be
        // the same after a resume, which would sample the batch again, with newer segments.
        let samples_ahead = config.learner.device == Device::Cuda && !config.run.deterministic;
        Ok(Self {
            pacing: Pacing::new(&config.pacing),
            batch: Batch::new(algorithm.batch_shape()),
            next_batch: samples_ahead.then(|| NextBatch::new(algorithm.batch_shape())),
            omega: match policy.head() {
                Head::Dmp(head) => head.omega(),
                Head::Mlp => 1.0,
            },
            cloning: match config.demonstrations.are_cloned() {
                true => Some(Cloning::new(config, policy)?),
                false => None,
            },
            algorithm,
        })
    }

    /// Returns whether the actor imitates demonstrations.
    #[must_use]
    pub fn is_cloning(&self) -> bool {
        self.cloning.is_some()
    }

    /// Samples a batch and updates the networks. Before and shortly after the end of the warm-up,
    /// an actor with demonstrations also imitates them.
    ///
    /// # Errors
    /// If there is nothing to sample, or a device operation fails.
    pub fn update(
        &mut self,
        config: &ExperimentConfig,
        policy: &Policy,
        mut source: SampleSource<'_>,
        progress: UpdateProgress,
    ) -> Result<Losses, LearnerError> {
        let shape = self.algorithm.batch_shape();
        let next = self.next_batch.as_mut();
        if !next.is_some_and(|next| next.take(&mut self.batch, source.sampler)) {
            self.batch.sample(shape, &config.algorithm, self.omega, &mut source)?;
        }
        let share = imitation_share(config, progress.env_steps);
        let losses = match self.cloning.take_if(|_| share > 0.0) {
            None => self.update_alone(config, policy, source, progress.update)?,
            Some(mut cloning) => {
                let imitation = Imitation { cloning: &mut cloning, share };
                let losses = self.update_beside(imitation, policy, source, progress.update);
                self.cloning = Some(cloning);
                losses?
            }
        };
        self.pacing.updated();
        Ok(losses)
    }

    /// Does one update without imitation. On a GPU, it also samples the next batch.
    fn update_alone(
        &mut self,
        config: &ExperimentConfig,
        policy: &Policy,
        source: SampleSource<'_>,
        update: u64,
    ) -> candle_core::Result<Losses> {
        let Self { algorithm, batch, next_batch, omega, .. } = self;
        let Some(next_batch) = next_batch else { return algorithm.update(policy, batch, update) };
        let SampleSource { replay, sampler, hindsight, jerk_cost, normaliser } = source;
        let shape = algorithm.batch_shape();
        let sample = |next: &mut Batch, sampler: &mut Sampler| {
            let mut source = SampleSource { replay, sampler, hindsight, jerk_cost, normaliser };
            next.sample(shape, &config.algorithm, *omega, &mut source)
        };
        next_batch.sample_during(sampler, sample, || algorithm.update(policy, batch, update))
    }

    /// Does one update. The actor takes `1 - share` of its own step and `share` of a step of
    /// imitation. A critic without training would mislead an actor that already imitates well.
    fn update_beside(
        &mut self,
        imitation: Imitation<'_>,
        policy: &Policy,
        source: SampleSource<'_>,
        update: u64,
    ) -> Result<Losses, LearnerError> {
        let Imitation { cloning, share } = imitation;
        self.algorithm.read_policy(&mut cloning.parameters)?;
        let losses = self.algorithm.update(policy, &self.batch, update)?;
        self.algorithm.fetch()?;
        self.algorithm.for_each_network(|name, network| {
            if name == "actor" {
                cloning.move_towards(&network.parameters, 1.0 - share);
            }
            Ok::<(), LearnerError>(())
        })?;
        cloning.sample(source)?;
        cloning.step(policy, self.algorithm.pool(), share)?;
        self.algorithm.for_each_network(|name, network| match name {
            "actor" => network.parameters.set(&cloning.parameters),
            _ => Ok(()),
        })?;
        Ok(losses)
    }

    /// Lets the actor imitate the demonstrations of the replay for `updates` updates. Returns
    /// `None` if no imitation is configured.
    ///
    /// # Errors
    /// If the demonstrations have no whole window, or the loss is not finite.
    pub fn clone_demonstrations(
        &mut self,
        policy: &Policy,
        mut source: SampleSource<'_>,
        updates: u64,
    ) -> Result<Option<CloningLosses>, LearnerError> {
        let Some(cloning) = &mut self.cloning else { return Ok(None) };
        self.algorithm.read_policy(&mut cloning.parameters)?;
        let tenth = updates.div_ceil(10);
        let (mut first, mut last) = (0.0, 0.0);
        for update in 0..updates {
            cloning.sample(source.reborrow())?;
            let value = cloning.step(policy, self.algorithm.pool(), 1.0)?;
            if !value.is_finite() {
                return Err(LearnerError::NotFinite { update, name: "cloning loss", value });
            }
            first += if update < tenth { value } else { 0.0 };
            last += if update >= updates - tenth { value } else { 0.0 };
        }
        self.algorithm.set_policy(&cloning.parameters)?;
        let tenth = tenth as f32;
        Ok(Some(CloningLosses { first: first / tenth, last: last / tenth }))
    }

    /// Calls `f` with every network and its name in a checkpoint. `f` may change the network.
    ///
    /// # Errors
    /// The first error that `f` returns.
    pub fn for_each_network<E>(
        &mut self,
        mut f: impl FnMut(&'static str, &mut TrainableNetwork) -> Result<(), E>,
    ) -> Result<(), E> {
        if let Some(next_batch) = &mut self.next_batch {
            // Its observations may be normalised for other networks.
            next_batch.discard();
        }
        self.algorithm.for_each_network(&mut f)?;
        self.cloning.as_mut().map_or(Ok(()), |cloning| f("cloning", &mut cloning.actor))
    }

    /// Returns every network with its name in a checkpoint.
    #[must_use]
    pub fn networks(&self) -> Vec<(&'static str, &TrainableNetwork)> {
        let cloning = self.cloning.iter().map(|cloning| ("cloning", &cloning.actor));
        self.algorithm.networks().into_iter().chain(cloning).collect()
    }
}

/// Imitation beside an update.
struct Imitation<'a> {
    cloning: &'a mut Cloning,
    /// Share of the actor's step, from 0 to 1.
    share: f32,
}

/// Returns the imitation's share of the actor's step: 1 until the end of the warm-up, then falling
/// linearly to 0 within `demonstrations.imitation_steps`.
fn imitation_share(config: &ExperimentConfig, env_steps: u64) -> f32 {
    let after = env_steps as f32 - config.exploration.warm_up_steps as f32;
    let steps = config.demonstrations.imitation_steps as f32;
    (1.0 - after.max(0.0) / steps.max(1.0)).max(0.0)
}
