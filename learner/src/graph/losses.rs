//! The figures of an update on the device.

use candle_core::{Result, Tensor};

use crate::algorithms::losses::Losses;

/// Figures of an update at most.
pub(super) const FIGURES: usize = 5;

/// Whether an update has the losses of actor, temperature and entropy.
#[derive(Debug, Clone, Copy)]
pub(super) struct Present([bool; 3]);

/// Losses of an update as scalars on the device.
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

    /// Copies the losses into `figures`, ([`FIGURES`],), on the device. Returns which are there.
    pub(super) fn write(self, figures: &Tensor) -> Result<Present> {
        let Self { critic_loss, q_mean, actor_loss, temperature, entropy } = self;
        let optional = [actor_loss, temperature, entropy];
        let present = optional.each_ref().map(Option::is_some);
        let scalars = [critic_loss, q_mean].into_iter().chain(optional.into_iter().flatten());
        let scalars = scalars.map(|scalar| scalar.detach().reshape(1));
        figures.slice_set(&Tensor::cat(&scalars.collect::<Result<Vec<_>>>()?, 0)?, 0, 0)?;
        Ok(Present(present))
    }
}

/// Waits for the update and copies its losses, which [`DeviceLosses::write`] has written, to the
/// host. Reading waits for the device, so they are read together.
pub(super) fn read(figures: &Tensor, Present(present): Present) -> Result<Losses> {
    let mut values = figures.to_vec1()?.into_iter();
    let mut next = || values.next().unwrap_or(f32::NAN);
    let [critic_loss, q_mean] = [next(), next()];
    let [actor_loss, temperature, entropy] = present.map(|is_there| is_there.then(&mut next));
    Ok(Losses { critic_loss, actor_loss, q_mean, temperature, entropy })
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;

    #[test]
    fn losses_are_read_under_their_own_names() {
        let scalar = |value: f32| Tensor::new(value, &Device::Cpu).unwrap();
        let figures = Tensor::zeros(FIGURES, DType::F32, &Device::Cpu).unwrap();
        let read = |losses: DeviceLosses| {
            let present = losses.write(&figures).unwrap();
            super::read(&figures, present).unwrap()
        };
        let losses = read(DeviceLosses::of_critics(scalar(1.0), scalar(2.0)));
        assert_eq!(losses, Losses { critic_loss: 1.0, q_mean: 2.0, ..Losses::default() });
        let losses = read(DeviceLosses {
            temperature: Some(Tensor::new(&[3.0_f32], &Device::Cpu).unwrap()),
            entropy: Some(scalar(4.0)),
            ..DeviceLosses::of_critics(scalar(1.0), scalar(2.0))
        });
        assert_eq!((losses.temperature, losses.entropy), (Some(3.0), Some(4.0)));
        assert_eq!(losses.actor_loss, None);
    }
}
