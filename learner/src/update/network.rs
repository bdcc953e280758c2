//! A network in training: its parameters, its target network and its optimiser.

use candle_core::Result;
use dmprl_shared::config::Precision;
use dmprl_shared::policy::{Activations, MlpShape};
use parking_lot::{RwLock, RwLockReadGuard};

use super::adam::Adam;
use super::arithmetic::Arithmetic;
use super::backward_pass::{BackwardPass, Gradients};
use super::bf16_operands::Bf16Operands;
use super::kernels::{Activation, AdamPass, Normalise, adam};
use super::layer_norm::{GainShift, LayerNorm, Normalised, NormalisedRowsMut};
use super::packed_weights::PackedWeights;
use super::step::{GradientSum, Tile, TiledAdamStep, tiles};
use super::thread_pool::{DisjointSlice, ThreadPool};
use crate::parameters::Parameters;

/// A network in training.
#[derive(Debug)]
pub struct TrainableNetwork {
    /// Its layers.
    pub shape: MlpShape,
    /// Layer normalisation of the hidden layers, if the network has it.
    pub layer_norm: Option<LayerNorm>,
    /// Its parameters, (P,).
    pub parameters: Parameters,
    /// Parameters of the target network, (P,), if the algorithm uses one.
    pub target: Option<Parameters>,
    /// The optimiser.
    pub adam: Adam,
    gradient: Vec<f32>,
    tiles: Vec<Tile>,
    /// Copies of the weights in the order in which the passes read them. They are behind a lock
    /// because a view updates an outdated copy first.
    packed: RwLock<PackedWeights>,
    target_packed: RwLock<PackedWeights>,
    bf16_operands: Bf16Operands,
    arithmetic: Arithmetic,
}

/// The recorded passes over one shard: everything that the parameters' gradient is summed
/// from.
#[derive(Debug, Clone, Copy)]
pub struct PassRecord<'a> {
    /// The network's inputs, (rows, inputs).
    pub inputs: &'a [f32],
    /// Outputs of all layers, from the forward pass.
    pub activations: &'a Activations,
    /// Normalised values of the hidden layers, from the forward pass with layer normalisation.
    pub normalised: Option<&'a Normalised>,
    /// Gradients at all layers, from the backward pass.
    pub gradients: &'a Gradients,
}

/// Factors of one optimiser step.
#[derive(Debug, Clone, Copy)]
pub struct StepScale {
    /// Multiplies the gradient.
    pub gradient: f32,
    /// Multiplies the learning rate.
    pub learning_rate: f32,
}

/// Read access to a network's parameters, shared by all threads of a step.
#[derive(Debug)]
pub struct NetworkView<'a> {
    shape: &'a MlpShape,
    layer_norm: Option<&'a LayerNorm>,
    parameters: &'a [f32],
    packed: RwLockReadGuard<'a, PackedWeights>,
}

impl<'a> PassRecord<'a> {
    /// Returns the inputs of layer `index`, (rows, inputs).
    #[must_use]
    pub fn layer_inputs(&self, shape: &MlpShape, index: usize, rows: usize) -> &'a [f32] {
        match index {
            0 => self.inputs,
            _ => self.activations.layer(shape, index - 1, rows),
        }
    }
}

impl NetworkView<'_> {
    /// Computes the outputs of all layers from `inputs`, (rows, inputs).
    ///
    /// # Panics
    /// If the network has layer normalisation and `normalised` is `None`.
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
                Some(gain_shift) => {
                    let rows = outputs.len() / layer.outputs;
                    let normalised = normalised.as_deref_mut().expect("buffers for normalisation");
                    let buffers = normalised.layer_mut(self.shape, index, rows);
                    self.forward_normalised(index, gain_shift, inputs, buffers, outputs);
                }
                None => {
                    let activation =
                        if index == last { Activation::Linear } else { Activation::Relu };
                    self.packed.forward(index, activation, self.parameters, inputs, outputs);
                }
            }
        }
    }

    fn forward_normalised(
        &self,
        index: usize,
        gain_shift: &GainShift,
        inputs: &[f32],
        buffers: NormalisedRowsMut<'_>,
        outputs: &mut [f32],
    ) {
        let parameters = self.parameters;
        let NormalisedRowsMut { values, inverse_std } = buffers;
        self.packed.forward(index, Activation::Linear, parameters, inputs, values);
        let gain = &parameters[gain_shift.gain.clone()];
        let shift = &parameters[gain_shift.shift.clone()];
        Normalise { values, inverse_std, gain, shift, outputs }.run(self.packed.instructions());
    }

    /// Returns the backward pass that follows a forward pass over `rows` rows.
    #[must_use]
    pub fn backward_pass<'b>(
        &'b self,
        activations: &'b Activations,
        normalised: Option<&'b Normalised>,
        rows: usize,
    ) -> BackwardPass<'b> {
        let (shape, parameters) = (self.shape, self.parameters);
        let normalised = self.layer_norm.zip(normalised);
        BackwardPass { shape, parameters, activations, normalised, rows, packed: &self.packed }
    }
}

impl TrainableNetwork {
    /// Makes a network with its optimiser. With `target`, the target network starts as a copy.
    ///
    /// # Errors
    /// If the processor does not support `precision`.
    pub fn new(
        shape: MlpShape,
        initial: Vec<f32>,
        learning_rate: f64,
        target: bool,
        precision: Precision,
    ) -> Result<Self> {
        let len = initial.len();
        let arithmetic = Arithmetic::new(precision)?;
        let parameters = Parameters::new(initial);
        Ok(Self {
            target: target.then(|| parameters.duplicate()),
            parameters,
            adam: Adam::new(len, learning_rate),
            gradient: vec![0.0; len],
            tiles: tiles(&shape),
            packed: RwLock::new(PackedWeights::new(&shape, arithmetic)),
            target_packed: RwLock::new(PackedWeights::new(&shape, arithmetic)),
            bf16_operands: Bf16Operands::default(),
            arithmetic,
            shape,
            layer_norm: None,
        })
    }

    /// Adds layer normalisation to a new network, with gains of one and shifts of zero.
    #[must_use]
    pub fn with_layer_norm(self) -> Self {
        let layer_norm = LayerNorm::new(&self.shape);
        let extended = |parameters: &Parameters| {
            let mut values = parameters.values().to_vec();
            layer_norm.extend(&mut values);
            Parameters::new(values)
        };
        let parameters = extended(&self.parameters);
        let len = parameters.values().len();
        Self {
            target: self.target.as_ref().map(extended),
            adam: Adam::new(len, self.adam.learning_rate()),
            gradient: vec![0.0; len],
            parameters,
            layer_norm: Some(layer_norm),
            ..self
        }
    }

    /// Makes a single trainable number with its optimiser.
    ///
    /// # Errors
    /// Never, because every processor supports 32-bit products.
    pub fn scalar(initial: f32, learning_rate: f64) -> Result<Self> {
        let shape = MlpShape::new(vec![0, 1]);
        Self::new(shape, vec![initial], learning_rate, false, Precision::F32)
    }

    /// Does one step of Adam on a single number.
    pub fn adam_step_scalar(&mut self, gradient: f32) {
        self.gradient[0] = gradient;
        self.apply_gradient(StepScale { gradient: 1.0, learning_rate: 1.0 });
    }

    /// Returns a view of the network.
    #[must_use]
    pub fn view(&self) -> NetworkView<'_> {
        self.view_of(&self.parameters, &self.packed)
    }

    /// Returns a view of the target network.
    ///
    /// # Errors
    /// If the network has no target.
    pub fn target_view(&self) -> Result<NetworkView<'_>> {
        match &self.target {
            Some(target) => Ok(self.view_of(target, &self.target_packed)),
            None => candle_core::bail!("the network has no target network"),
        }
    }

    fn view_of<'a>(
        &'a self,
        parameters: &'a Parameters,
        packed: &'a RwLock<PackedWeights>,
    ) -> NetworkView<'a> {
        let (shape, values) = (&self.shape, parameters.values());
        let layer_norm = self.layer_norm.as_ref();
        if packed.read().revision != parameters.revision() {
            let mut packed = packed.write();
            packed.fill(values);
            packed.revision = parameters.revision();
        }
        NetworkView { shape, layer_norm, parameters: values, packed: packed.read() }
    }

    /// Does one step of Adam with the gradient that the passes over the shards recorded, and moves
    /// the target network by `polyak` of the way. Without `polyak`, the target stays.
    pub fn adam_step<'b, B: Sync>(
        &mut self,
        pool: &mut ThreadPool,
        shards: &'b [B],
        record: impl Fn(&'b B) -> PassRecord<'b> + Sync,
        polyak: Option<f32>,
    ) {
        let Self { shape, layer_norm, parameters, target, adam, gradient, .. } = self;
        let Self { tiles, bf16_operands, arithmetic, .. } = self;
        let arithmetic = *arithmetic;
        bf16_operands.fill(shape, arithmetic, pool, shards, &record);
        let (packed, target_packed) = (self.packed.get_mut(), self.target_packed.get_mut());
        let mut target = target.as_mut().filter(|_| polyak.is_some());
        let step = TiledAdamStep {
            sizes: adam.next_step(),
            polyak,
            sum: GradientSum {
                shape,
                layer_norm: layer_norm.as_ref(),
                arithmetic,
                bf16_operands,
                gradient: DisjointSlice::new(gradient),
            },
            parameters: DisjointSlice::new(parameters.values_mut()),
            target: DisjointSlice::new(match &mut target {
                Some(target) => target.values_mut(),
                None => &mut [],
            }),
            first: DisjointSlice::new(&mut adam.moments.first),
            second: DisjointSlice::new(&mut adam.moments.second),
            packed: packed.writer(),
            target_packed: target_packed.writer(),
        };
        pool.run(tiles.len(), &|index| step.tile(&tiles[index], shards, &record));
        // The step has updated the packed copies, too.
        packed.revision = parameters.revision();
        if let Some(target) = target {
            target_packed.revision = target.revision();
        }
    }

    /// Sums the gradient that the passes over the shards recorded, without a step, for algorithms
    /// that need its norm first.
    pub fn sum_gradient<'b, B: Sync>(
        &mut self,
        pool: &mut ThreadPool,
        shards: &'b [B],
        record: impl Fn(&'b B) -> PassRecord<'b> + Sync,
    ) {
        let Self { shape, layer_norm, gradient, tiles, bf16_operands, arithmetic, .. } = self;
        bf16_operands.fill(shape, *arithmetic, pool, shards, &record);
        let gradient = DisjointSlice::new(gradient);
        let (layer_norm, arithmetic) = (layer_norm.as_ref(), *arithmetic);
        let sum = GradientSum { shape, layer_norm, arithmetic, bf16_operands, gradient };
        pool.run(tiles.len(), &|index| sum.tile(&tiles[index], shards, &record));
    }

    /// Does one step of Adam with the current gradient. The target network stays.
    pub fn apply_gradient(&mut self, scale: StepScale) {
        self.gradient.iter_mut().for_each(|gradient| *gradient *= scale.gradient);
        let sizes = self.adam.next_step().scaled(scale.learning_rate);
        let pass = AdamPass {
            parameters: self.parameters.values_mut(),
            first: &mut self.adam.moments.first,
            second: &mut self.adam.moments.second,
            gradient: &self.gradient,
            target_step: None,
            sizes,
        };
        adam(pass, self.arithmetic.instructions);
    }

    /// Returns the sum of the squares of the current gradient.
    #[must_use]
    pub fn gradient_square(&self) -> f64 {
        self.gradient.iter().map(|gradient| f64::from(*gradient).powi(2)).sum()
    }

    /// Returns the current gradient, (P,), for callers that compute it without a backward pass.
    pub fn gradient_mut(&mut self) -> &mut [f32] {
        &mut self.gradient
    }

    /// Sets the gradient to that of a step done on another device.
    pub fn set_gradient(&mut self, gradient: &[f32]) {
        self.gradient.copy_from_slice(gradient);
    }

    /// Returns the gradient of the last step, (P,).
    #[must_use]
    pub fn gradient(&self) -> &[f32] {
        &self.gradient
    }
}
