//! TD3 as a graph; see `algorithms::td3` for paper and differences.

use candle_core::Result;
use dmprl_shared::config::ExperimentConfig;

use super::batch::{DeviceBatch, needed};
use super::losses::DeviceLosses;
use super::{CriticStep, Graph, GraphAlgorithm, Of};

const CRITICS: [&str; 2] = ["critic_1", "critic_2"];

/// Variant of an update that leaves the actor and all targets as they are.
const CRITICS_ONLY: u64 = 0;
/// Variant of an update of all networks.
const WITH_ACTOR: u64 = 1;

#[derive(Debug)]
pub(super) struct Td3;

impl GraphAlgorithm for Td3 {
    fn variant(&self, config: &ExperimentConfig, update: u64) -> u64 {
        match update.is_multiple_of(config.algorithm.td3.actor_interval) {
            true => WITH_ACTOR,
            false => CRITICS_ONLY,
        }
    }

    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, variant: u64) -> Result<DeviceLosses> {
        let td3 = graph.config.algorithm.td3.clone();
        let updates_actor = variant == WITH_ACTOR;

        let next = graph.means(Of::Target, &batch.next_states)?;
        let clip = td3.target_noise_clip;
        let noise = (needed(&batch.next_noise, "next_noise")? * td3.target_noise_std)?
            .clamp(-clip, clip)?;
        let u = (next.means.tanh()? + noise)?.clamp(-1.0, 1.0)?;
        let inputs = graph.critic_inputs(&batch.next_states, &next.with_end_state(&u)?)?;
        let [first, second] = CRITICS.map(|critic| graph.forward(critic, Of::Target, &inputs));
        let (first, second) = (first?, second?);
        let weight = td3.target_smaller_weight;
        let larger = (first.maximum(&second)? * (1.0 - weight))?;
        let values = ((first.minimum(&second)? * weight)? + larger)?;

        let CriticStep { losses, q_size } =
            graph.fit_critics(&CRITICS, batch, &values, updates_actor)?;
        let step = || graph.policy_gradient_step(CRITICS[0], batch, &q_size);
        Ok(DeviceLosses { actor_loss: updates_actor.then(step).transpose()?, ..losses })
    }
}
