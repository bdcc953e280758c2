//! The figures of an update on the device.

use candle_core::{Result, Tensor};

use crate::algorithms::losses::Losses;

/// Losses of an update as scalars on the device. Reading a scalar waits for the device, so they are
/// read together, after the whole update has been handed to it.
#[derive(Debug)]
pub(super) struct DeviceLosses {
    /// As in [`Losses`].
    pub(super) critic_loss: Tensor,
    /// As in [`Losses`].
    pub(super) q_mean: Tensor,
    /// As in [`Losses`].
    pub(super) actor_loss: Option<Tensor>,
    /// As in [`Losses`].
    pub(super) temperature: Option<Tensor>,
    /// As in [`Losses`].
    pub(super) entropy: Option<Tensor>,
}

impl DeviceLosses {
    /// Returns the losses of a critic step.
    pub(super) fn of_critics(critic_loss: Tensor, q_mean: Tensor) -> Self {
        Self { critic_loss, q_mean, actor_loss: None, temperature: None, entropy: None }
    }

    /// Waits for the update and copies its losses to the host.
    pub(super) fn read(self) -> Result<Losses> {
        let Self { critic_loss, q_mean, actor_loss, temperature, entropy } = self;
        let optional = [actor_loss, temperature, entropy];
        let has = optional.each_ref().map(Option::is_some);
        let scalars = [critic_loss, q_mean].into_iter().chain(optional.into_iter().flatten());
        let scalars = scalars.map(|scalar| scalar.detach().reshape(1));
        let values = Tensor::cat(&scalars.collect::<Result<Vec<_>>>()?, 0)?.to_vec1()?;
        let mut values = values.into_iter();
        let mut next = || values.next().unwrap_or(f32::NAN);
        let [critic_loss, q_mean] = [next(), next()];
        let [actor_loss, temperature, entropy] = has.map(|has| has.then(&mut next));
        Ok(Losses { critic_loss, actor_loss, q_mean, temperature, entropy })
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    #[test]
    fn losses_are_read_under_their_own_names() {
        let scalar = |value: f32| Tensor::new(value, &Device::Cpu).unwrap();
        let losses = DeviceLosses::of_critics(scalar(1.0), scalar(2.0)).read().unwrap();
        assert_eq!(losses, Losses { critic_loss: 1.0, q_mean: 2.0, ..Losses::default() });
        let losses = DeviceLosses {
            temperature: Some(Tensor::new(&[3.0_f32], &Device::Cpu).unwrap()),
            entropy: Some(scalar(4.0)),
            ..DeviceLosses::of_critics(scalar(1.0), scalar(2.0))
        };
        let losses = losses.read().unwrap();
        assert_eq!((losses.temperature, losses.entropy), (Some(3.0), Some(4.0)));
        assert_eq!(losses.actor_loss, None);
    }
}
