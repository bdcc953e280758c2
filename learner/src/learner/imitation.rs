//! How a learner starts from demonstrations, and how they give way to what it learns itself.

use super::{Learner, LearnerError};
use crate::algorithms::Losses;
use crate::algorithms::cloning::Cloning;
use crate::demonstrations::Steps;

impl Learner {
    /// Keeps demonstrations in the replay and lets the actor imitate them for as many updates as
    /// the configuration says; returns the mean loss of the first and of the last tenth of these.
    ///
    /// # Errors
    /// If they do not fit into the replay, or hold no whole window.
    pub fn demonstrate(
        &mut self,
        demonstrations: &[Steps],
    ) -> Result<Option<(f32, f32)>, LearnerError> {
        for steps in demonstrations {
            steps.enter(&mut self.replay)?;
            if let Some(normaliser) = &mut self.normaliser {
                normaliser.observe(&steps.observations);
            }
        }
        let updates = self.config.demonstrations.cloning_updates;
        if self.normaliser.is_some() {
            self.take_normaliser_anew()?;
        }
        let Some(cloning) = &mut self.cloning else { return Ok(None) };
        self.algorithm.read_policy(&mut cloning.parameters)?;
        let tenth = updates.div_ceil(10);
        let (mut first, mut last) = (0.0, 0.0);
        for update in 0..updates {
            cloning.sample(self.normaliser.as_ref(), (&self.replay, &mut self.sampler))?;
            let value = cloning.step(&self.policy, 1.0)?;
            if !value.is_finite() {
                return Err(LearnerError::NotFinite { update, name: "cloning loss", value });
            }
            first += if update < tenth { value } else { 0.0 };
            last += if update >= updates - tenth { value } else { 0.0 };
        }
        let parameters = cloning.parameters.clone();
        self.warm_start(&parameters)?;
        Ok(Some((first / tenth as f32, last / tenth as f32)))
    }

    /// A critic that knows nothing yet would soon lead an actor that imitates astray: through the
    /// warm-up the actor goes on imitating instead of following it, and then less and less so.
    pub(super) fn update_networks(&mut self) -> Result<Losses, LearnerError> {
        let update = self.counters.updates + 1;
        let share = self.cloning_share();
        let Some(mut cloning) = self.cloning.take_if(|_| share > 0.0) else {
            return Ok(self.algorithm.update(&self.policy, &self.batch, update)?);
        };
        let result = self.update_beside(&mut cloning, share);
        self.cloning = Some(cloning);
        result
    }

    /// One update of which the actor follows 1 - `share`, and `share` of a step of imitation.
    fn update_beside(&mut self, cloning: &mut Cloning, share: f32) -> Result<Losses, LearnerError> {
        let update = self.counters.updates + 1;
        self.algorithm.read_policy(&mut cloning.parameters)?;
        let losses = self.algorithm.update(&self.policy, &self.batch, update)?;
        self.algorithm.fetch()?;
        self.algorithm.each_network(|name, trained| {
            if name == "actor" {
                cloning.follow(&trained.network, 1.0 - share);
            }
            Ok::<(), LearnerError>(())
        })?;
        cloning.sample(self.normaliser.as_ref(), (&self.replay, &mut self.sampler))?;
        cloning.step(&self.policy, share)?;
        self.algorithm.each_network(|name, trained| match name {
            "actor" => trained.network.set(&cloning.parameters),
            _ => Ok(()),
        })?;
        Ok(losses)
    }

    /// From 1, through the warm-up, to 0 when the steps of imitation are over.
    fn cloning_share(&self) -> f32 {
        let after = self.counters.env_steps as f32 - self.config.exploration.warm_up_steps as f32;
        let steps = self.config.demonstrations.imitation_steps as f32;
        (1.0 - after.max(0.0) / steps.max(1.0)).max(0.0)
    }
}
