//! A network, its slowly following target and its optimiser; and the step that all take together.

use candle_core::Result;
use dmprl_shared::config::Precision;
use dmprl_shared::policy::{Activations, MlpShape};
use parking_lot::{RwLock, RwLockReadGuard};

use super::adam::Adam;
use super::arithmetic::Arithmetic;
use super::batch_pairs::BatchPairs;
use super::crew::{Crew, Disjoint};
use super::kernels::{AdamPass, adam};
use super::packed::Packed;
use super::pass::{Gradients, Pass};
use super::step::{Step, Tile, tiles};
use crate::networks::Parameters;

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
    pairs: BatchPairs,
    arithmetic: Arithmetic,
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
    parameters: &'a [f32],
    packed: RwLockReadGuard<'a, Packed>,
}

impl<'a> Trace<'a> {
    /// The inputs of layer `index`, (rows, inputs).
    #[must_use]
    pub fn layer_inputs(&self, shape: &MlpShape, index: usize, rows: usize) -> &'a [f32] {
        match index {
            0 => self.inputs,
            _ => self.activations.layer(shape, index - 1, rows),
        }
    }
}

impl Lent<'_> {
    /// Runs the network on `inputs`, (rows, inputs).
    pub fn forward(&self, inputs: &[f32], activations: &mut Activations) {
        for index in 0..self.shape.layers().len() {
            let (inputs, outputs) = activations.step(self.shape, index, inputs);
            self.packed.forward(self.shape, index, self.parameters, inputs, outputs);
        }
    }

    /// The network after its forward pass over `rows` rows.
    #[must_use]
    pub fn pass<'b>(&'b self, activations: &'b Activations, rows: usize) -> Pass<'b> {
        let (shape, parameters) = (self.shape, self.parameters);
        Pass { shape, parameters, activations, rows, packed: &self.packed }
    }
}

impl Trained {
    /// A network with its optimiser and, if `target`, a copy of it that follows.
    ///
    /// # Errors
    /// If the processor lacks the precision.
    pub fn new(
        shape: MlpShape,
        initial: Vec<f32>,
        learning_rate: f64,
        target: bool,
        precision: Precision,
    ) -> Result<Self> {
        let len = initial.len();
        let arithmetic = Arithmetic::new(precision)?;
        let network = Parameters::new(initial);
        Ok(Self {
            target: target.then(|| network.duplicate()),
            network,
            adam: Adam::new(len, learning_rate),
            gradient: vec![0.0; len],
            tiles: tiles(&shape),
            packed: RwLock::new(Packed::new(&shape, arithmetic)),
            target_packed: RwLock::new(Packed::new(&shape, arithmetic)),
            pairs: BatchPairs::default(),
            arithmetic,
            shape,
        })
    }

    /// A single number with its optimiser.
    ///
    /// # Errors
    /// If candle cannot make the variable.
    pub fn scalar(initial: f32, learning_rate: f64) -> Result<Self> {
        let shape = MlpShape::new(vec![0, 1]);
        Self::new(shape, vec![initial], learning_rate, false, Precision::F32)
    }

    /// One step of Adam of a single number.
    pub fn descend_scalar(&mut self, gradient: f32) {
        self.gradient[0] = gradient;
        let sizes = self.adam.next_step();
        let pass = AdamPass {
            parameters: self.network.values_mut(),
            first: &mut self.adam.moments.first,
            second: &mut self.adam.moments.second,
            gradient: &self.gradient,
            follow: None,
            sizes,
        };
        adam(pass, self.arithmetic.instructions);
    }

    /// Lends the network.
    #[must_use]
    pub fn lend(&self) -> Lent<'_> {
        self.lend_parameters(&self.network, &self.packed)
    }

    /// Lends the target.
    ///
    /// # Errors
    /// If there is none.
    pub fn lend_target(&self) -> Result<Lent<'_>> {
        match &self.target {
            Some(target) => Ok(self.lend_parameters(target, &self.target_packed)),
            None => candle_core::bail!("a network without a target"),
        }
    }

    fn lend_parameters<'a>(
        &'a self,
        network: &'a Parameters,
        packed: &'a RwLock<Packed>,
    ) -> Lent<'a> {
        let (shape, parameters) = (&self.shape, network.values());
        if packed.read().changes != network.changes() {
            let mut packed = packed.write();
            packed.fill(shape, parameters);
            packed.changes = network.changes();
        }
        Lent { shape, parameters, packed: packed.read() }
    }

    /// One step of Adam along the gradient that the blocks' passes left; the target, if any,
    /// follows by `polyak` of the way.
    pub fn descend<'b, B: Sync>(
        &mut self,
        crew: &Crew,
        blocks: &'b [B],
        trace: impl Fn(&'b B) -> Trace<'b> + Sync,
        polyak: Option<f32>,
    ) {
        let Self { shape, network, target, adam, gradient, tiles, pairs, arithmetic, .. } = self;
        let arithmetic = *arithmetic;
        pairs.fill(shape, arithmetic, crew, blocks, &trace);
        let (packed, target_packed) = (self.packed.get_mut(), self.target_packed.get_mut());
        let mut target = target.as_mut().filter(|_| polyak.is_some());
        let step = Step {
            shape,
            sizes: adam.next_step(),
            polyak,
            arithmetic,
            pairs,
            parameters: Disjoint::new(network.values_mut()),
            target: Disjoint::new(match &mut target {
                Some(target) => target.values_mut(),
                None => &mut [],
            }),
            gradient: Disjoint::new(gradient),
            first: Disjoint::new(&mut adam.moments.first),
            second: Disjoint::new(&mut adam.moments.second),
            packed: packed.pieces(),
            target_packed: target_packed.pieces(),
        };
        crew.run(tiles.len(), &|index| step.tile(&tiles[index], blocks, &trace));
        // The step has kept the copies up to date.
        packed.changes = network.changes();
        if let Some(target) = target {
            target_packed.changes = target.changes();
        }
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
