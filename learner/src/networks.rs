//! The parameters of a network, flat.
//!
//! One flat vector a network: a snapshot, a Polyak step, an Adam step and a checkpoint are each one
//! pass over one slice. It is ours rather than a candle variable, whose every change in place
//! allocates; the candle graph of another device makes variables of its own from it.

use candle_core::Result;

/// The parameters of one network.
#[derive(Debug)]
pub struct Parameters {
    values: Vec<f32>,
    /// How often the values were changed: whoever keeps a copy in another order can tell whether
    /// it is still theirs.
    changes: u64,
}

impl Parameters {
    /// Takes over drawn or loaded parameters.
    #[must_use]
    pub fn new(values: Vec<f32>) -> Self {
        Self { values, changes: 1 }
    }

    /// A copy with values of its own.
    #[must_use]
    pub fn duplicate(&self) -> Self {
        Self::new(self.values.clone())
    }

    /// (P,).
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// (P,), to change them.
    pub fn values_mut(&mut self) -> &mut [f32] {
        self.changes += 1;
        &mut self.values
    }

    /// A number that every change of the values makes greater; at least 1.
    #[must_use]
    pub fn changes(&self) -> u64 {
        self.changes
    }

    /// Replaces the values.
    ///
    /// # Errors
    /// If the lengths differ.
    pub fn set(&mut self, values: &[f32]) -> Result<()> {
        let len = self.values.len();
        if values.len() != len {
            candle_core::bail!("network has {len} parameters, got {}", values.len());
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
        let before = parameters.changes();
        parameters.values_mut()[1] = 7.0;
        assert!(parameters.changes() > before);
        assert_eq!((parameters.values(), copy.values()), (&[1.0, 7.0, 3.0][..], &[1., 2., 3.][..]));
        assert!(parameters.set(&[0.0; 2]).is_err());
    }
}
