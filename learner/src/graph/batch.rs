//! A batch on the device.

use candle_core::{Result, Tensor};
use dmprl_shared::policy::{Head, Policy};

use super::policy::DeviceStates;
use super::{FACTORS, Graph};
use crate::algorithms::batch::Batch;

/// The tensors of a [`Batch`]. Unused ones are `None`, because a GPU has no empty tensors.
#[derive(Debug)]
pub(super) struct DeviceBatch {
    /// s_t.
    pub(super) states: DeviceStates,
    /// The states from which targets bootstrap.
    pub(super) next_states: DeviceStates,
    /// Critic inputs with the batch's own actions, (B, critic inputs).
    pub(super) critic_inputs: Tensor,
    /// Standard normal noise for the actions after the window, (B, K A), for TD3, SAC and TQC.
    pub(super) next_noise: Option<Tensor>,
    /// Standard normal noise for the actor's own actions, (B, K A), for SAC and TQC.
    pub(super) noise: Option<Tensor>,
    /// u_{t-2} and u_{t-1}, (B, 2A).
    pub(super) previous_actions: Tensor,
    /// 1 if u_{t-2}, and u_{t-1}, exist, else 0, (B, 2).
    pub(super) has_previous: Tensor,
    /// 1 if the window led to its goal, else 0, (B, 1).
    pub(super) led_to_goal: Tensor,
    /// Motion of the achieved goal, (B, K G), for the outcome model.
    pub(super) motion: Option<Tensor>,
    rewards: Tensor,
    bootstrap: Tensor,
    target_range: [f32; 2],
}

impl DeviceBatch {
    /// Returns reward + bootstrap * `next_values` without gradients, for (B, N) values, within the
    /// range that the rewards allow.
    pub(super) fn targets(&self, next_values: &Tensor) -> Result<Tensor> {
        let values = next_values.broadcast_mul(&self.bootstrap)?;
        let [low, high] = self.target_range;
        Ok(values.broadcast_add(&self.rewards)?.clamp(low, high)?.detach())
    }
}

/// Returns a part of a batch that the algorithm needs.
///
/// # Errors
/// If the batch was sampled without it.
pub(super) fn needed<'a>(part: &'a Option<Tensor>, name: &str) -> Result<&'a Tensor> {
    match part {
        Some(part) => Ok(part),
        None => candle_core::bail!("the batch has no {name}"),
    }
}

/// The numbers of the host that an update needs, on the device.
#[derive(Debug)]
pub(super) struct Upload {
    /// All parts, one after the other.
    block: Tensor,
    lens: [usize; PARTS],
    target_range: [f32; 2],
}

/// The tensors of a batch, and the factors of Adam's steps.
const PARTS: usize = 16;

impl Graph {
    /// Copies a batch to the device. It is one copy, because each has a price besides its bytes.
    pub(super) fn upload(&mut self, policy: &Policy, batch: &Batch) -> Result<()> {
        let starts = |observations: &Vec<f32>| match policy.head() {
            Head::Dmp(head) => head.starts(observations),
            Head::Mlp => Vec::new(),
        };
        let observations = [&batch.observations, &batch.next_observations];
        let [starts, next_starts] = observations.map(starts);
        let [distances, next_distances] = observations.map(|rows| self.goal_distances(rows));
        let factors: Vec<_> = self.networks.iter().flat_map(|it| it.next_factors()).collect();
        let parts: [&[f32]; PARTS] = [
            &batch.inputs,
            &starts,
            &distances,
            &batch.next_inputs,
            &next_starts,
            &next_distances,
            &batch.critic_inputs,
            &batch.next_noise,
            &batch.noise,
            &batch.previous_actions,
            &batch.has_previous,
            &batch.led_to_goal,
            &batch.motion,
            &batch.rewards,
            &batch.bootstrap,
            &factors,
        ];
        let lens = parts.map(<[f32]>::len);
        let block = Tensor::from_vec(parts.concat(), lens.iter().sum::<usize>(), &self.device)?;
        let target_range = batch.target_range;
        match &self.upload {
            Some(last) if last.lens == lens && last.target_range == target_range => {
                last.block.slice_set(&block, 0, 0)
            }
            _ => {
                self.upload = Some(Upload { block, lens, target_range });
                #[cfg(feature = "cuda")]
                self.recordings.forget();
                Ok(())
            }
        }
    }

    /// Returns the batch that was copied to the device.
    pub(super) fn batch(&self) -> Result<DeviceBatch> {
        let Upload { block, lens, target_range } = self.uploaded()?;
        let [lens @ .., _] = *lens;
        let mut end = 0;
        let views = lens.map(|len| {
            end += len;
            (len > 0).then(|| block.narrow(0, end - len, len)?.reshape((self.shape.rows, ())))
        });
        let [inputs, starts, distances, next_inputs, next_starts, next_distances, views @ ..] =
            views;
        let [critic_inputs, next_noise, noise, previous_actions, has_previous, views @ ..] = views;
        let [led_to_goal, motion, rewards, bootstrap] = views;
        Ok(DeviceBatch {
            states: self.states(inputs, starts, distances)?,
            next_states: self.states(next_inputs, next_starts, next_distances)?,
            critic_inputs: present(critic_inputs)?,
            next_noise: next_noise.transpose()?,
            noise: noise.transpose()?,
            previous_actions: present(previous_actions)?,
            has_previous: present(has_previous)?,
            led_to_goal: present(led_to_goal)?,
            motion: motion.transpose()?,
            rewards: present(rewards)?,
            bootstrap: present(bootstrap)?,
            target_range: *target_range,
        })
    }

    /// Returns the factors of the next step of network number `network`, ([`FACTORS`],), which were
    /// copied to the device.
    pub(super) fn factors(&self, network: usize) -> Result<Tensor> {
        let Upload { block, lens, .. } = self.uploaded()?;
        let [before @ .., _] = lens;
        block.narrow(0, before.iter().sum::<usize>() + network * FACTORS, FACTORS)
    }

    fn uploaded(&self) -> Result<&Upload> {
        match &self.upload {
            Some(upload) => Ok(upload),
            None => candle_core::bail!("there is no batch on the device"),
        }
    }

    fn states(&self, inputs: View, starts: View, distances: View) -> Result<DeviceStates> {
        Ok(DeviceStates {
            inputs: present(inputs)?,
            starts: starts.transpose()?.map(|starts| starts.reshape(((), 2))).transpose()?,
            goal_distances: distances.transpose()?.map(|it| it.unsqueeze(1)).transpose()?,
        })
    }
}

/// A part of a batch's block, (B, N), or `None` if it is empty.
type View = Option<Result<Tensor>>;

fn present(view: View) -> Result<Tensor> {
    view.unwrap_or_else(|| candle_core::bail!("a part of the batch is empty"))
}

#[cfg(test)]
impl Graph {
    /// Fails if a batch has tensors that candle takes on a CPU, but not on a GPU: empty ones, and
    /// inputs of products whose rows have gaps.
    pub(crate) fn assert_fits_a_gpu(&mut self, policy: &Policy, batch: &Batch) {
        self.upload(policy, batch).unwrap();
        let batch = self.batch().unwrap();
        let DeviceBatch { states, next_states, critic_inputs, next_noise, noise, .. } = &batch;
        let mut optional = vec![next_noise, noise, &batch.motion];
        for states in [states, next_states] {
            optional.extend([&states.starts, &states.goal_distances]);
        }
        let always = [critic_inputs, &states.inputs, &next_states.inputs, &batch.rewards];
        for tensor in always.into_iter().chain(optional.into_iter().flatten()) {
            assert!(tensor.elem_count() > 0 && tensor.is_contiguous(), "{:?}", tensor.layout());
        }
        assert!(self.model_inputs(critic_inputs).unwrap().is_contiguous());
    }
}
