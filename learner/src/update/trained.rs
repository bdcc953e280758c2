//! A network, its slowly following target and its optimiser; and the step that all take together.

use std::ops::Range;

use candle_core::{Layout, Result, Storage};
use dmprl_shared::policy::{Activations, Keep, Matrix, MlpShape, forward, product};
use parking_lot::RwLockReadGuard;

use super::adam::{Adam, Slices};
use super::crew::{Crew, Disjoint};
use super::pass::{Gradients, Pass};
use crate::networks::Parameters;

/// Rows of a weight matrix whose gradient and step are one part of the work.
const TILE_ROWS: usize = 32;

/// A network in training.
#[derive(Debug)]
pub struct Trained {
    /// Its layers.
    pub shape: MlpShape,
    /// Its parameters.
    pub network: Parameters,
    /// The target's; none where the algorithm has none.
    pub target: Option<Parameters>,
    /// The optimiser.
    pub adam: Adam,
    gradient: Vec<f32>,
    tiles: Vec<Tile>,
}

/// Some rows of one layer.
#[derive(Debug, Clone)]
struct Tile {
    layer: usize,
    outputs: Range<usize>,
}

/// One block's part in the gradient of a network: (rows, inputs), and what the passes left.
#[derive(Debug, Clone, Copy)]
pub struct Trace<'a> {
    /// The network's inputs, (rows, inputs).
    pub inputs: &'a [f32],
    /// What the forward pass left.
    pub activations: &'a Activations,
    /// What the backward pass left.
    pub gradients: &'a Gradients,
}

/// A network's parameters, lent to all threads of a step.
#[derive(Debug)]
pub struct Lent<'a> {
    shape: &'a MlpShape,
    storage: RwLockReadGuard<'a, Storage>,
    layout: &'a Layout,
}

impl Lent<'_> {
    fn parameters(&self) -> &[f32] {
        crate::networks::values(&self.storage, self.layout).unwrap_or_default()
    }

    /// Runs the network on `inputs`, (rows, inputs).
    pub fn forward(&self, inputs: &[f32], activations: &mut Activations) {
        forward(self.shape, self.parameters(), inputs, activations);
    }

    /// The network after its forward pass over `rows` rows.
    #[must_use]
    pub fn pass<'b>(&'b self, activations: &'b Activations, rows: usize) -> Pass<'b> {
        Pass { shape: self.shape, parameters: self.parameters(), activations, rows }
    }
}

impl Trained {
    /// A network with its optimiser and, if `target`, a copy of it that follows.
    ///
    /// # Errors
    /// If candle cannot make the variables.
    pub fn new(
        shape: MlpShape,
        initial: Vec<f32>,
        learning_rate: f64,
        target: bool,
    ) -> Result<Self> {
        let len = initial.len();
        let network = Parameters::new(initial)?;
        Ok(Self {
            target: target.then(|| network.duplicate()).transpose()?,
            network,
            adam: Adam::new(len, learning_rate),
            gradient: vec![0.0; len],
            tiles: tiles(&shape),
            shape,
        })
    }

    /// A single number with its optimiser.
    ///
    /// # Errors
    /// If candle cannot make the variable.
    pub fn scalar(initial: f32, learning_rate: f64) -> Result<Self> {
        Self::new(MlpShape::new(vec![0, 1]), vec![initial], learning_rate, false)
    }

    /// One step of Adam of a single number.
    ///
    /// # Errors
    /// If candle refuses access to the variable.
    pub fn descend_scalar(&mut self, gradient: f32) -> Result<()> {
        self.gradient[0] = gradient;
        let step = self.adam.next_step();
        let (first, second) = (&mut self.adam.moments.first, &mut self.adam.moments.second);
        let gradient = &self.gradient;
        self.network.update(|parameters| {
            step.update(Slices { parameters, gradient, first, second }, None);
        })
    }

    /// Lends the network.
    ///
    /// # Errors
    /// If candle refuses access to the variable.
    pub fn lend(&self) -> Result<Lent<'_>> {
        self.lend_parameters(&self.network)
    }

    /// Lends the target.
    ///
    /// # Errors
    /// If candle refuses access to the variable, or there is none.
    pub fn lend_target(&self) -> Result<Lent<'_>> {
        match &self.target {
            Some(target) => self.lend_parameters(target),
            None => candle_core::bail!("a network without a target"),
        }
    }

    fn lend_parameters<'a>(&'a self, parameters: &'a Parameters) -> Result<Lent<'a>> {
        let (storage, layout) = parameters.var().storage_and_layout();
        crate::networks::values(&storage, layout)?;
        Ok(Lent { shape: &self.shape, storage, layout })
    }

    /// One step of Adam along the gradient that the blocks' passes left; the target, if any,
    /// follows by `polyak` of the way.
    ///
    /// # Errors
    /// If candle refuses access to a variable.
    pub fn descend<'b, B: Sync>(
        &mut self,
        crew: &Crew,
        blocks: &'b [B],
        trace: impl Fn(&'b B) -> Trace<'b> + Sync,
        polyak: Option<f32>,
    ) -> Result<()> {
        let Self { shape, network, target, adam, gradient, tiles } = self;
        let step = adam.next_step();
        let (first, second) = (&mut adam.moments.first, &mut adam.moments.second);
        let mut run = |parameters: &mut [f32], target: &mut [f32]| {
            let parameters = Disjoint::new(parameters);
            let target = Disjoint::new(target);
            let gradient = Disjoint::new(gradient);
            let (first, second) = (Disjoint::new(first), Disjoint::new(second));
            crew.run(tiles.len(), &|index| {
                let tile = &tiles[index];
                for (range, is_bias) in tile.ranges(shape) {
                    // SAFETY: tiles do not overlap, nor do a tile's two ranges.
                    let (parameters, gradient, first, second) = unsafe {
                        (
                            parameters.slice(range.clone()),
                            gradient.slice(range.clone()),
                            first.slice(range.clone()),
                            second.slice(range.clone()),
                        )
                    };
                    // SAFETY: as above.
                    let follower = polyak
                        .filter(|_| !target.is_empty())
                        .map(|share| (unsafe { target.slice(range.clone()) }, share));
                    gradient.fill(0.0);
                    for block in blocks {
                        tile.add(shape, trace(block), is_bias, gradient);
                    }
                    step.update(Slices { parameters, gradient, first, second }, follower);
                }
            });
        };
        // One closure inside the other: candle hands out one storage at a time.
        let mut followed = Ok(());
        network.update(|parameters| match target {
            Some(target) if polyak.is_some() => {
                followed = target.update(|target| run(parameters, target));
            }
            _ => run(parameters, &mut []),
        })?;
        followed
    }

    /// The gradient of the last step, (P,).
    #[must_use]
    pub fn gradient(&self) -> &[f32] {
        &self.gradient
    }
}

fn tiles(shape: &MlpShape) -> Vec<Tile> {
    let of_layer = |(layer, outputs): (usize, usize)| {
        (0..outputs)
            .step_by(TILE_ROWS)
            .map(move |first| Tile { layer, outputs: first..(first + TILE_ROWS).min(outputs) })
    };
    shape.layers().iter().map(|layer| layer.outputs).enumerate().flat_map(of_layer).collect()
}

impl Tile {
    /// Where its weights and its biases stand in the flat parameters.
    fn ranges(&self, shape: &MlpShape) -> [(Range<usize>, bool); 2] {
        let layer = &shape.layers()[self.layer];
        let Range { start, end } = self.outputs;
        let weights = layer.weights.start;
        let bias = layer.bias.start;
        [
            (weights + start * layer.inputs..weights + end * layer.inputs, false),
            (bias + start..bias + end, true),
        ]
    }

    /// Adds one block's part of the gradient.
    fn add(&self, shape: &MlpShape, trace: Trace<'_>, is_bias: bool, out: &mut [f32]) {
        let rows = trace.inputs.len() / shape.inputs();
        let layer = &shape.layers()[self.layer];
        let gradient = trace.gradients.layer(shape, self.layer, rows);
        let Range { start, end } = self.outputs;
        if is_bias {
            for row in gradient.chunks_exact(layer.outputs) {
                for (bias, gradient) in out.iter_mut().zip(&row[start..end]) {
                    *bias += gradient;
                }
            }
            return;
        }
        let inputs = match self.layer {
            0 => trace.inputs,
            index => trace.activations.layer(shape, index - 1, rows),
        };
        let inputs = Matrix::row_major(inputs, rows, layer.inputs);
        let gradient = Matrix::row_major(gradient, rows, layer.outputs);
        let gradient = gradient.columns(self.outputs.clone()).transposed();
        product(out, gradient, inputs, Keep::Add);
    }
}
