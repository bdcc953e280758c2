//! Layer normalisation (Ba et al. 2016) of a network's hidden layers, before their ReLU: where its
//! parameters stand, and what its passes leave.
//!
//! It is for critics: whatever an action is, the last layer sees hidden values of a bounded size,
//! so that Q beyond the data stays bounded by the norm of its weights (Ball et al. 2023, "Efficient
//! online reinforcement learning with offline data"). Policies do not have it.

use std::ops::Range;

use dmprl_shared::policy::MlpShape;

/// Where gains and shifts of all hidden layers stand: behind the layers' weights and biases in the
/// flat parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayerNorm {
    layers: Vec<GainShift>,
}

/// One layer's gain and shift in the flat parameters, (outputs,) each.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GainShift {
    /// What a normalised value is multiplied by.
    pub gain: Range<usize>,
    /// What is added to it then.
    pub shift: Range<usize>,
}

impl LayerNorm {
    /// After every layer of `shape` but the last.
    #[must_use]
    pub fn new(shape: &MlpShape) -> Self {
        let mut at = shape.parameters_len();
        let hidden = &shape.layers()[..shape.layers().len() - 1];
        let place = |width: usize| {
            let gain = at..at + width;
            let shift = gain.end..gain.end + width;
            at = shift.end;
            GainShift { gain, shift }
        };
        Self { layers: hidden.iter().map(|layer| layer.outputs).map(place).collect() }
    }

    /// Gain and shift of layer `index`; the last layer has none.
    #[must_use]
    pub fn layer(&self, index: usize) -> Option<&GainShift> {
        self.layers.get(index)
    }

    /// Puts gains of one and shifts of zero behind a network's other parameters.
    pub fn extend(&self, parameters: &mut Vec<f32>) {
        for GainShift { gain, shift } in &self.layers {
            parameters.resize(gain.end, 1.0);
            parameters.resize(shift.end, 0.0);
        }
    }
}

/// What the forward pass leaves of every hidden layer for the backward pass, for up to `rows_max`
/// rows.
#[derive(Debug)]
pub struct Normalised {
    layers: Vec<NormalisedLayer>,
}

#[derive(Debug)]
struct NormalisedLayer {
    values: Vec<f32>,
    inverse_std: Vec<f32>,
}

impl Normalised {
    /// Buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        let hidden = &shape.layers()[..shape.layers().len() - 1];
        let layer = |width: usize| NormalisedLayer {
            values: vec![0.0; rows_max * width],
            inverse_std: vec![0.0; rows_max],
        };
        Self { layers: hidden.iter().map(|l| layer(l.outputs)).collect() }
    }

    /// Normalised values of layer `index`, (rows, outputs), and 1 / std of their rows, (rows,).
    #[must_use]
    pub fn layer(&self, shape: &MlpShape, index: usize, rows: usize) -> [&[f32]; 2] {
        let NormalisedLayer { values, inverse_std } = &self.layers[index];
        [&values[..rows * shape.layers()[index].outputs], &inverse_std[..rows]]
    }

    /// As [`Normalised::layer`], to write them.
    pub fn layer_mut(&mut self, shape: &MlpShape, index: usize, rows: usize) -> [&mut [f32]; 2] {
        let NormalisedLayer { values, inverse_std } = &mut self.layers[index];
        [&mut values[..rows * shape.layers()[index].outputs], &mut inverse_std[..rows]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gains_and_shifts_stand_behind_all_weights_and_leave_the_last_layer_alone() {
        let shape = MlpShape::new(vec![3, 4, 2, 1]);
        let norm = LayerNorm::new(&shape);
        let mut parameters = vec![7.0; shape.parameters_len()];
        norm.extend(&mut parameters);
        let at = shape.parameters_len();
        assert_eq!(norm.layer(0), Some(&GainShift { gain: at..at + 4, shift: at + 4..at + 8 }));
        assert_eq!(
            norm.layer(1),
            Some(&GainShift { gain: at + 8..at + 10, shift: at + 10..at + 12 })
        );
        assert_eq!(norm.layer(2), None);
        assert_eq!(parameters[at..], [1., 1., 1., 1., 0., 0., 0., 0., 1., 1., 0., 0.]);
    }
}
