//! A network, its slowly following target and its optimiser; and the step that all take together.

use std::ops::Range;

use candle_core::{Layout, Result, Storage};
use dmprl_shared::policy::{Activations, MlpShape};
use parking_lot::{RwLock, RwLockReadGuard};

use super::adam::Adam;
use super::crew::{Crew, Disjoint};
use super::kernels::{
    Activation, AdamPass, Follow, Forward, GradientBlock, InstructionSet, PANEL, StepSizes,
    WeightGradient, adam, pack,
};
use super::packed::Packed;
use super::pass::{Gradients, Pass};
use crate::networks::Parameters;

/// Outputs of a layer whose gradient and step are one part of the work: whole panels.
const TILE_OUTPUTS: usize = PANEL;

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
    /// The weights of network and target in the order of the forward pass. Behind a lock because
    /// whoever lends them to a step brings them up to date first.
    packed: RwLock<Packed>,
    target_packed: RwLock<Packed>,
    instructions: InstructionSet,
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
    packed: RwLockReadGuard<'a, Packed>,
    instructions: InstructionSet,
}

impl Lent<'_> {
    fn parameters(&self) -> &[f32] {
        crate::networks::values(&self.storage, self.layout).unwrap_or_default()
    }

    /// Runs the network on `inputs`, (rows, inputs).
    pub fn forward(&self, inputs: &[f32], activations: &mut Activations) {
        let parameters = self.parameters();
        let last = self.shape.layers().len() - 1;
        for (index, layer) in self.shape.layers().iter().enumerate() {
            let (inputs, outputs) = activations.step(self.shape, index, inputs);
            let activation = if index < last { Activation::Relu } else { Activation::Linear };
            let bias = &parameters[layer.bias.clone()];
            let packed = self.packed.layer(index);
            Forward { inputs, packed, bias, activation, outputs }.run(self.instructions);
        }
    }

    /// The network after its forward pass over `rows` rows.
    #[must_use]
    pub fn pass<'b>(&'b self, activations: &'b Activations, rows: usize) -> Pass<'b> {
        let (shape, parameters) = (self.shape, self.parameters());
        Pass { shape, parameters, activations, rows, instructions: self.instructions }
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
            packed: RwLock::new(Packed::new(&shape)),
            target_packed: RwLock::new(Packed::new(&shape)),
            instructions: InstructionSet::detect(),
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
        let sizes = self.adam.next_step();
        let (first, second) = (&mut self.adam.moments.first[..], &mut self.adam.moments.second[..]);
        let (gradient, instructions) = (&self.gradient[..], self.instructions);
        self.network.update(|parameters| {
            let follow = None;
            adam(AdamPass { parameters, first, second, gradient, follow, sizes }, instructions);
        })
    }

    /// Lends the network.
    ///
    /// # Errors
    /// If candle refuses access to the variable.
    pub fn lend(&self) -> Result<Lent<'_>> {
        self.lend_parameters(&self.network, &self.packed)
    }

    /// Lends the target.
    ///
    /// # Errors
    /// If candle refuses access to the variable, or there is none.
    pub fn lend_target(&self) -> Result<Lent<'_>> {
        match &self.target {
            Some(target) => self.lend_parameters(target, &self.target_packed),
            None => candle_core::bail!("a network without a target"),
        }
    }

    fn lend_parameters<'a>(
        &'a self,
        parameters: &'a Parameters,
        packed: &'a RwLock<Packed>,
    ) -> Result<Lent<'a>> {
        let (storage, layout) = parameters.var().storage_and_layout();
        let values = crate::networks::values(&storage, layout)?;
        if packed.read().changes != parameters.changes() {
            let mut packed = packed.write();
            packed.fill(&self.shape, values, self.instructions);
            packed.changes = parameters.changes();
        }
        let (shape, instructions) = (&self.shape, self.instructions);
        Ok(Lent { shape, storage, layout, packed: packed.read(), instructions })
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
        let Self { shape, network, target, adam, gradient, tiles, .. } = self;
        let (packed, target_packed) = (self.packed.get_mut(), self.target_packed.get_mut());
        let target = target.as_ref().filter(|_| polyak.is_some());
        let (sizes, instructions) = (adam.next_step(), self.instructions);
        let (first, second) = (&mut adam.moments.first, &mut adam.moments.second);
        let mut run = |parameters: &mut [f32], target: &mut [f32]| {
            let step = Step {
                shape,
                sizes,
                polyak,
                instructions,
                parameters: Disjoint::new(parameters),
                target: Disjoint::new(target),
                gradient: Disjoint::new(gradient),
                first: Disjoint::new(first),
                second: Disjoint::new(second),
                packed: Disjoint::new(packed.values_mut()),
                target_packed: Disjoint::new(target_packed.values_mut()),
            };
            crew.run(tiles.len(), &|index| step.tile(&tiles[index], blocks, &trace));
        };
        // One closure inside the other: candle hands out one storage at a time.
        let mut followed = Ok(());
        network.update(|parameters| match target {
            Some(target) => followed = target.update(|target| run(parameters, target)),
            None => run(parameters, &mut []),
        })?;
        // The step has kept the copies up to date.
        packed.changes = network.changes();
        if let Some(target) = target {
            target_packed.changes = target.changes();
        }
        followed
    }

    /// Takes over the gradient of a step that was done elsewhere.
    pub fn set_gradient(&mut self, gradient: &[f32]) {
        self.gradient.copy_from_slice(gradient);
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
            .step_by(TILE_OUTPUTS)
            .map(move |first| Tile { layer, outputs: first..(first + TILE_OUTPUTS).min(outputs) })
    };
    shape.layers().iter().map(|layer| layer.outputs).enumerate().flat_map(of_layer).collect()
}

/// What the threads of one step of Adam share.
struct Step<'a> {
    shape: &'a MlpShape,
    sizes: StepSizes,
    polyak: Option<f32>,
    instructions: InstructionSet,
    parameters: Disjoint<'a, f32>,
    /// Empty: no target follows.
    target: Disjoint<'a, f32>,
    gradient: Disjoint<'a, f32>,
    first: Disjoint<'a, f32>,
    second: Disjoint<'a, f32>,
    packed: Disjoint<'a, f32>,
    target_packed: Disjoint<'a, f32>,
}

impl Step<'_> {
    /// Gradient, Adam, target and packed copies of one tile, one after the other while its numbers
    /// are in the cache.
    fn tile<'b, B>(&self, tile: &Tile, blocks: &'b [B], trace: &impl Fn(&'b B) -> Trace<'b>) {
        let (shape, outputs) = (self.shape, tile.outputs.clone());
        let layer = &shape.layers()[tile.layer];
        let within =
            |begin: usize, width: usize| begin + outputs.start * width..begin + outputs.end * width;
        let weights_at = within(layer.weights.start, layer.inputs);
        let bias_at = within(layer.bias.start, 1);
        let gradient_blocks = blocks.iter().map(|block| {
            let trace = trace(block);
            let rows = trace.inputs.len() / shape.inputs();
            let gradient = trace.gradients.layer(shape, tile.layer, rows);
            let inputs = match tile.layer {
                0 => trace.inputs,
                index => trace.activations.layer(shape, index - 1, rows),
            };
            GradientBlock { gradient, inputs }
        });
        // SAFETY: tiles do not overlap, nor do a tile's weights and biases.
        let (weights, bias) = unsafe {
            (self.gradient.slice(weights_at.clone()), self.gradient.slice(bias_at.clone()))
        };
        WeightGradient {
            blocks: gradient_blocks,
            inputs_len: layer.inputs,
            outputs_len: layer.outputs,
            outputs: outputs.clone(),
            weights,
            bias,
        }
        .run(self.instructions);
        self.adam(bias_at);
        self.adam(weights_at.clone());
        let packed_at = Packed::range(shape, tile.layer, outputs);
        // SAFETY: tiles do not overlap, and this one's slices above are no longer in use.
        unsafe {
            let weights = self.parameters.slice(weights_at.clone());
            let packed = self.packed.slice(packed_at.clone());
            pack(weights, layer.inputs, layer.outputs, packed, self.instructions);
            if !self.target.is_empty() {
                let weights = self.target.slice(weights_at);
                let packed = self.target_packed.slice(packed_at);
                pack(weights, layer.inputs, layer.outputs, packed, self.instructions);
            }
        }
    }

    fn adam(&self, range: Range<usize>) {
        // SAFETY: called for ranges of one tile, one after the other, and tiles do not overlap.
        let pass = unsafe {
            AdamPass {
                parameters: self.parameters.slice(range.clone()),
                first: self.first.slice(range.clone()),
                second: self.second.slice(range.clone()),
                gradient: self.gradient.slice(range.clone()),
                follow: self
                    .polyak
                    .filter(|_| !self.target.is_empty())
                    .map(|polyak| Follow { target: self.target.slice(range), polyak }),
                sizes: self.sizes,
            }
        };
        adam(pass, self.instructions);
    }
}
