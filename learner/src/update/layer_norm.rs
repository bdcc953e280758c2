//! Layer normalisation (Ba et al. 2016) of a network's hidden layers, before their ReLU: the layout
//! of its parameters and the buffers of its passes.
//!
//! Only critics use it. It bounds the hidden values that the last layer sees, whatever the action,
//! so that Q outside the data is bounded by the norm of the last layer's weights (Ball et al. 2023,
//! "Efficient online reinforcement learning with offline data").

use std::ops::Range;

use dmprl_shared::policy::MlpShape;

/// Ranges of the gains and shifts of all hidden layers. They follow the weights and biases in the
/// flat parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayerNorm {
    layers: Vec<GainShift>,
}

/// Ranges of gain and shift in the flat parameters, (outputs,) each.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GainShift {
    /// Multiplies the normalised values.
    pub gain: Range<usize>,
    /// Is added to the product.
    pub shift: Range<usize>,
}

impl LayerNorm {
    /// Normalises every layer of `shape` except the last.
    #[must_use]
    pub fn new(shape: &MlpShape) -> Self {
        let mut at = shape.parameters_len();
        let hidden = &shape.layers()[..shape.layers().len() - 1];
        let gain_shift = |width: usize| {
            let gain = at..at + width;
            let shift = gain.end..gain.end + width;
            at = shift.end;
            GainShift { gain, shift }
        };
        Self { layers: hidden.iter().map(|layer| layer.outputs).map(gain_shift).collect() }
    }

    /// Returns the ranges of layer `index`; the last layer has none.
    #[must_use]
    pub fn layer(&self, index: usize) -> Option<&GainShift> {
        self.layers.get(index)
    }

    /// Appends gains of one and shifts of zero to a network's other parameters.
    pub fn extend(&self, parameters: &mut Vec<f32>) {
        for GainShift { gain, shift } in &self.layers {
            parameters.resize(gain.end, 1.0);
            parameters.resize(shift.end, 0.0);
        }
    }
}

/// Normalised values of all hidden layers, which the forward pass keeps for the backward pass.
#[derive(Debug)]
pub struct Normalised {
    layers: Vec<NormalisedLayer>,
}

#[derive(Debug)]
struct NormalisedLayer {
    values: Vec<f32>,
    inverse_std: Vec<f32>,
}

/// Some rows of one normalised layer.
#[derive(Debug, Clone, Copy)]
pub struct NormalisedRows<'a> {
    /// The normalised values, (rows, outputs).
    pub values: &'a [f32],
    /// 1 / standard deviation of each row, (rows,).
    pub inverse_std: &'a [f32],
}

/// Some rows of one normalised layer, for writing.
#[derive(Debug)]
pub struct NormalisedRowsMut<'a> {
    /// The normalised values, (rows, outputs).
    pub values: &'a mut [f32],
    /// 1 / standard deviation of each row, (rows,).
    pub inverse_std: &'a mut [f32],
}

impl Normalised {
    /// Allocates buffers for up to `rows_max` rows.
    #[must_use]
    pub fn new(shape: &MlpShape, rows_max: usize) -> Self {
        let hidden = &shape.layers()[..shape.layers().len() - 1];
        let layer = |width: usize| NormalisedLayer {
            values: vec![0.0; rows_max * width],
            inverse_std: vec![0.0; rows_max],
        };
        Self { layers: hidden.iter().map(|l| layer(l.outputs)).collect() }
    }

    /// Returns the first `rows` rows of layer `index`.
    #[must_use]
    pub fn layer(&self, shape: &MlpShape, index: usize, rows: usize) -> NormalisedRows<'_> {
        let NormalisedLayer { values, inverse_std } = &self.layers[index];
        let len = rows * shape.layers()[index].outputs;
        NormalisedRows { values: &values[..len], inverse_std: &inverse_std[..rows] }
    }

    /// Returns the first `rows` rows of layer `index` for writing.
    pub fn layer_mut(
        &mut self,
        shape: &MlpShape,
        index: usize,
        rows: usize,
    ) -> NormalisedRowsMut<'_> {
        let NormalisedLayer { values, inverse_std } = &mut self.layers[index];
        let len = rows * shape.layers()[index].outputs;
        NormalisedRowsMut { values: &mut values[..len], inverse_std: &mut inverse_std[..rows] }
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
