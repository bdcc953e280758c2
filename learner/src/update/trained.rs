//! A network, its slowly following target and its optimiser; and the step that all take together.

use candle_core::Result;
use dmprl_shared::config::Precision;
use dmprl_shared::policy::{Activations, Layer, MlpShape};
use parking_lot::{RwLock, RwLockReadGuard};

use super::adam::Adam;
use super::arithmetic::Arithmetic;
use super::batch_pairs::BatchPairs;
use super::crew::{Crew, Disjoint};
use super::kernels::{Activation, AdamPass, Normalise, adam};
use super::layer_norm::{GainShift, LayerNorm, Normalised};
use super::packed::Packed;
use super::pass::{Gradients, Pass};
use super::step::{GradientSum, Step, Tile, tiles};
use crate::networks::Parameters;

/// A network in training.
#[derive(Debug)]
pub struct Trained {
    /// Its layers.
    pub shape: MlpShape,
    /// The normalisation of its hidden layers, if they have one.
    pub layer_norm: Option<LayerNorm>,
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
    /// The same of a network with layer normalisation.
    pub normalised: Option<&'a Normalised>,
    /// What the backward pass left.
    pub gradients: &'a Gradients,
}

/// What a step is scaled by.
#[derive(Debug, Clone, Copy)]
pub struct Scaling {
    /// Multiplies the gradient.
    pub factor: f32,
    /// Multiplies the learning rate.
    pub share: f32,
}

/// A network's parameters, lent to all threads of a step.
#[derive(Debug)]
pub struct Lent<'a> {
    shape: &'a MlpShape,
    layer_norm: Option<&'a LayerNorm>,
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
    ///
    /// # Panics
    /// If a network with layer normalisation is given no buffers for it.
    pub fn forward(
        &self,
        inputs: &[f32],
        activations: &mut Activations,
        mut normalised: Option<&mut Normalised>,
    ) {
        let last = self.shape.layers().len() - 1;
        for (index, layer) in self.shape.layers().iter().enumerate() {
            let (inputs, outputs) = activations.step(self.shape, index, inputs);
            match self.layer_norm.and_then(|norm| norm.layer(index)) {
                Some(places) => {
                    let rows = outputs.len() / layer.outputs;
                    let normalised = normalised.as_deref_mut().expect("normalised layers");
                    let buffers = normalised.layer_mut(self.shape, index, rows);
                    self.forward_normalised((index, layer), places, inputs, buffers, outputs);
                }
                None => {
                    let activation =
                        if index == last { Activation::Linear } else { Activation::Relu };
                    let parameters = self.parameters;
                    self.packed.forward((index, layer), activation, parameters, inputs, outputs);
                }
            }
        }
    }

    fn forward_normalised(
        &self,
        layer: (usize, &Layer),
        places: &GainShift,
        inputs: &[f32],
        [values, inverse_std]: [&mut [f32]; 2],
        outputs: &mut [f32],
    ) {
        let parameters = self.parameters;
        self.packed.forward(layer, Activation::Linear, parameters, inputs, values);
        let gain = &parameters[places.gain.clone()];
        let shift = &parameters[places.shift.clone()];
        Normalise { values, inverse_std, gain, shift, outputs }.run(self.packed.instructions());
    }

    /// The network after its forward pass over `rows` rows.
    #[must_use]
    pub fn pass<'b>(
        &'b self,
        activations: &'b Activations,
        normalised: Option<&'b Normalised>,
        rows: usize,
    ) -> Pass<'b> {
        let (shape, parameters) = (self.shape, self.parameters);
        let normalised = self.layer_norm.zip(normalised);
        Pass { shape, parameters, activations, normalised, rows, packed: &self.packed }
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
            layer_norm: None,
        })
    }

    /// The same, fresh network with layer normalisation, gains of one and shifts of zero.
    #[must_use]
    pub fn with_layer_norm(self) -> Self {
        let layer_norm = LayerNorm::new(&self.shape);
        let lengthened = |parameters: &Parameters| {
            let mut values = parameters.values().to_vec();
            layer_norm.extend(&mut values);
            Parameters::new(values)
        };
        let network = lengthened(&self.network);
        let len = network.values().len();
        Self {
            target: self.target.as_ref().map(lengthened),
            adam: Adam::new(len, self.adam.learning_rate()),
            gradient: vec![0.0; len],
            network,
            layer_norm: Some(layer_norm),
            ..self
        }
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
        self.step(Scaling { factor: 1.0, share: 1.0 });
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
        let layer_norm = self.layer_norm.as_ref();
        if packed.read().changes != network.changes() {
            let mut packed = packed.write();
            packed.fill(shape, parameters);
            packed.changes = network.changes();
        }
        Lent { shape, layer_norm, parameters, packed: packed.read() }
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
        let Self { shape, layer_norm, network, target, adam, gradient, .. } = self;
        let Self { tiles, pairs, arithmetic, .. } = self;
        let arithmetic = *arithmetic;
        pairs.fill(shape, arithmetic, crew, blocks, &trace);
        let (packed, target_packed) = (self.packed.get_mut(), self.target_packed.get_mut());
        let mut target = target.as_mut().filter(|_| polyak.is_some());
        let step = Step {
            sizes: adam.next_step(),
            polyak,
            sum: GradientSum {
                shape,
                layer_norm: layer_norm.as_ref(),
                arithmetic,
                pairs,
                gradient: Disjoint::new(gradient),
            },
            parameters: Disjoint::new(network.values_mut()),
            target: Disjoint::new(match &mut target {
                Some(target) => target.values_mut(),
                None => &mut [],
            }),
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

    /// Sums the gradient that the blocks' passes left, without a step: for algorithms that must
    /// know its length first.
    pub fn sum_gradient<'b, B: Sync>(
        &mut self,
        crew: &Crew,
        blocks: &'b [B],
        trace: impl Fn(&'b B) -> Trace<'b> + Sync,
    ) {
        let Self { shape, layer_norm, gradient, tiles, pairs, arithmetic, .. } = self;
        pairs.fill(shape, *arithmetic, crew, blocks, &trace);
        let gradient = Disjoint::new(gradient);
        let (layer_norm, arithmetic) = (layer_norm.as_ref(), *arithmetic);
        let sum = GradientSum { shape, layer_norm, arithmetic, pairs, gradient };
        crew.run(tiles.len(), &|index| sum.tile(&tiles[index], blocks, &trace));
    }

    /// One step of Adam along the gradient at hand times `factor`, with `share` of the learning
    /// rate. The target, if any, stays.
    pub fn step(&mut self, Scaling { factor, share }: Scaling) {
        self.gradient.iter_mut().for_each(|gradient| *gradient *= factor);
        let sizes = self.adam.next_step().scaled(share);
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

    /// Sum of the squares of the gradient at hand.
    #[must_use]
    pub fn gradient_square(&self) -> f64 {
        self.gradient.iter().map(|gradient| f64::from(*gradient).powi(2)).sum()
    }

    /// The gradient at hand, to fill where no pass of a network does.
    pub fn gradient_mut(&mut self) -> &mut [f32] {
        &mut self.gradient
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
