//! The parameters of a network as one flat vector.
//!
//! A snapshot, a Polyak step, an Adam step and a checkpoint are each one pass over one slice. The
//! vector is not a candle variable, because candle allocates at every change in place. The graph
//! for another device copies it into variables of its own.

use candle_core::Result;

/// The parameters of one network.
#[derive(Debug)]
pub struct Parameters {
    values: Vec<f32>,
    /// Increases with every change, so that a copy can tell whether it is outdated.
    revision: u64,
}

impl Parameters {
    /// Takes ownership of drawn or loaded parameters.
    #[must_use]
    pub fn new(values: Vec<f32>) -> Self {
        Self { values, revision: 1 }
    }

    /// Returns an independent copy.
    #[must_use]
    pub fn duplicate(&self) -> Self {
        Self::new(self.values.clone())
    }

    /// Returns the values, (P,).
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Returns the values, (P,), for writing. This counts as a change.
    pub fn values_mut(&mut self) -> &mut [f32] {
        self.revision += 1;
        &mut self.values
    }

    /// Returns a number that increases with every change; at least 1.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Replaces the values.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set(&mut self, values: &[f32]) -> Result<()> {
        let len = self.values.len();
        if values.len() != len {
            candle_core::bail!("expected {len} parameters, got {}", values.len());
        }
        self.values_mut().copy_from_slice(values);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_is_counted_and_leaves_a_copy_as_it_was() {
        let mut parameters = Parameters::new(vec![1.0, 2.0, 3.0]);
        let copy = parameters.duplicate();
        let before = parameters.revision();
        parameters.values_mut()[1] = 7.0;
        assert!(parameters.revision() > before);
        assert_eq!((parameters.values(), copy.values()), (&[1.0, 7.0, 3.0][..], &[1., 2., 3.][..]));
        assert!(parameters.set(&[0.0; 2]).is_err());
    }
}
