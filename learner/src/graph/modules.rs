//! Networks that are built with candle-nn, on parameters in one vector.
//!
//! A network's parameters are one vector everywhere: optimiser, target and checkpoint handle it as
//! a whole. candle-nn asks a `VarBuilder` for named variables instead. The builders here hand out
//! parts of the vector, in the order in which they are asked for.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use candle_core::{DType, Device, Module, Result, Shape, Tensor};
use candle_nn::init::NormalOrUniform;
use candle_nn::var_builder::SimpleBackend;
use candle_nn::{Init, Linear, VarBuilder};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::MlpShape;
use dmprl_shared::seeds::{self, Stream};
use parking_lot::Mutex;
use rand::RngExt;
use rand_distr::StandardNormal;

use super::policy::normalise;
use crate::update::layer_norm::LayerNorm;
use crate::update::network::TrainableNetwork;

/// A part of a network's parameters.
#[derive(Debug, Clone)]
pub(super) struct Variable {
    name: String,
    shape: Shape,
    range: Range<usize>,
}

impl Variable {
    /// Returns the variables of a multilayer perceptron: weights and bias of each layer, then gain
    /// and shift of each normalised one.
    pub(super) fn of_mlp(shape: &MlpShape, layer_norm: Option<&LayerNorm>) -> Vec<Self> {
        let part = |shape: Shape, range: &Range<usize>| Self {
            name: String::new(),
            shape,
            range: range.clone(),
        };
        let layers = shape.layers().iter().flat_map(|layer| {
            let weights = part((layer.outputs, layer.inputs).into(), &layer.weights);
            [weights, part(layer.outputs.into(), &layer.bias)]
        });
        let normalised = (0..shape.layers().len())
            .filter_map(|index| layer_norm.and_then(|norm| norm.layer(index)))
            .flat_map(|norm| {
                [&norm.gain, &norm.shift].map(|range| part(range.len().into(), range))
            });
        layers.chain(normalised).collect()
    }

    /// Returns this part of all parameters, (P,).
    pub(super) fn view(&self, parameters: &Tensor) -> Result<Tensor> {
        let part = parameters.narrow(0, self.range.start, self.range.len())?;
        part.reshape(self.shape.clone())
    }
}

/// Draws a critic with its target on the host: asks `build` for its variables, and draws each from
/// the random stream `name`. Its inputs begin with the observation.
///
/// # Errors
/// If the network cannot be built, or its first layer is not a linear one. When the normalisation
/// of observations changes, the first layer is rewritten.
pub(super) fn draw(
    config: &ExperimentConfig,
    name: &str,
    inputs: usize,
    build: impl Fn(VarBuilder<'_>) -> Result<Box<dyn Module>>,
) -> Result<TrainableNetwork> {
    let random = seeds::stream(config.run.seed, name, 0);
    let (_, Recorded { variables, values, .. }) = record(Some(random), build)?;
    let first = variables.first().map(|first| first.shape.dims().to_vec()).unwrap_or_default();
    let second = variables.get(1).map(|second| second.shape.dims().to_vec()).unwrap_or_default();
    let outputs = match *first {
        [outputs, columns] if columns == inputs && second == [outputs] => outputs,
        _ => candle_core::bail!(
            "{name} must begin with the weights, ({inputs} columns), and the bias of a linear \
             layer of its inputs; it begins with {first:?} and {second:?}"
        ),
    };
    // The shape describes the first layer only. The rest follows it in the vector.
    let shape = MlpShape::new(vec![inputs, outputs]);
    let rate = config.algorithm.critic_learning_rate;
    TrainableNetwork::new(shape, values, rate, true, config.learner.precision)
}

/// Returns a network's variables in the order in which `build` asks for them, if it builds one.
///
/// # Errors
/// If the network cannot be built.
pub(super) fn variables(
    build: impl Fn(VarBuilder<'_>) -> Result<Option<Box<dyn Module>>>,
) -> Result<Option<Vec<Variable>>> {
    let (module, recorded) = record(None, build)?;
    Ok(module.map(|_| recorded.variables))
}

/// Returns a builder that hands out the tensors of a network's variables.
pub(super) fn builder(
    variables: &[Variable],
    tensors: Vec<Tensor>,
    device: &Device,
) -> VarBuilder<'static> {
    let names = variables.iter().map(|variable| variable.name.clone());
    let named: HashMap<_, _> = names.zip(tensors).collect();
    VarBuilder::from_tensors(named, DType::F32, device)
}

/// A linear layer with PyTorch's initialisation, which all our networks have.
///
/// # Errors
/// If the builder has no such variables.
pub(super) fn linear(inputs: usize, outputs: usize, builder: &VarBuilder<'_>) -> Result<Linear> {
    let bound = 1.0 / (inputs as f64).sqrt();
    let range = Init::Uniform { lo: -bound, up: bound };
    let weights = builder.get_with_hints((outputs, inputs), "weight", range)?;
    Ok(Linear::new(weights, Some(builder.get_with_hints(outputs, "bias", range)?)))
}

/// Layer normalisation with a gradient, which candle-nn's own has not for its fast path.
///
/// # Errors
/// If the builder has no such variables.
pub(super) fn layer_norm(len: usize, builder: &VarBuilder<'_>) -> Result<impl Module + 'static> {
    let gain = builder.get_with_hints(len, "gain", Init::Const(1.0))?;
    let shift = builder.get_with_hints(len, "shift", Init::Const(0.0))?;
    Ok(move |x: &Tensor| normalise(x, &gain, &shift))
}

/// Asks `build` for its variables. Without random numbers they are zero.
fn record<T>(
    random: Option<Stream>,
    build: impl Fn(VarBuilder<'_>) -> Result<T>,
) -> Result<(T, Recorded)> {
    let recorded = Recorded { random, variables: Vec::new(), values: Vec::new() };
    let recorder = Recorder(Arc::new(Mutex::new(Some(recorded))));
    let shared = Arc::clone(&recorder.0);
    let built = build(VarBuilder::from_backend(Box::new(recorder), DType::F32, Device::Cpu))?;
    match shared.lock().take() {
        Some(recorded) => Ok((built, recorded)),
        None => candle_core::bail!("a network was recorded twice"),
    }
}

/// Draws every variable that it is asked for, until the result is taken.
struct Recorder(Arc<Mutex<Option<Recorded>>>);

struct Recorded {
    random: Option<Stream>,
    variables: Vec<Variable>,
    values: Vec<f32>,
}

impl SimpleBackend for Recorder {
    fn get(
        &self,
        shape: Shape,
        name: &str,
        init: Init,
        _: DType,
        device: &Device,
    ) -> Result<Tensor> {
        let mut recorded = self.0.lock();
        let Some(Recorded { random, variables, values }) = &mut *recorded else {
            candle_core::bail!("the variable {name} is asked for too late");
        };
        if variables.iter().any(|variable| variable.name == name) {
            candle_core::bail!("a network has two variables named {name}");
        }
        let start = values.len();
        let count = shape.elem_count();
        match random {
            Some(random) => {
                values.extend((0..count).map(|_| init_value(init, &shape, random) as f32));
            }
            None => values.resize(start + count, 0.0),
        }
        let tensor = Tensor::from_slice(&values[start..], shape.clone(), device)?;
        let range = start..values.len();
        variables.push(Variable { name: name.to_owned(), shape, range });
        Ok(tensor)
    }

    fn get_unchecked(&self, name: &str, _: DType, _: &Device) -> Result<Tensor> {
        candle_core::bail!("the variable {name} has no shape")
    }

    fn contains_tensor(&self, _: &str) -> bool {
        true
    }
}

fn init_value(init: Init, shape: &Shape, random: &mut Stream) -> f64 {
    let mut uniform = |bound: f64| random.random_range(-1.0..1.0) * bound;
    match init {
        Init::Const(value) => value,
        Init::Uniform { lo, up } => f64::midpoint(lo, up) + uniform((up - lo) / 2.0),
        Init::Randn { mean, stdev } => mean + stdev * random.sample::<f64, _>(StandardNormal),
        Init::Kaiming { dist, fan, non_linearity } => {
            let std = non_linearity.gain() / (fan.for_shape(shape) as f64).sqrt();
            match dist {
                NormalOrUniform::Uniform => uniform(3.0_f64.sqrt() * std),
                NormalOrUniform::Normal => std * random.sample::<f64, _>(StandardNormal),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use candle_nn::seq;

    use super::super::Of;
    use super::super::network::DeviceNetwork;
    use super::*;

    fn two_layers(builder: &VarBuilder<'_>) -> Result<Box<dyn Module>> {
        let first = linear(3, 2, &builder.pp("first"))?;
        Ok(Box::new(seq().add(first).add(linear(2, 1, &builder.pp("second"))?)))
    }

    #[test]
    fn a_network_is_drawn_from_the_runs_seed_and_its_name() {
        let values = |seed: u64, name: &str| {
            let mut config = ExperimentConfig::default();
            config.run.seed = seed;
            let network = draw(&config, name, 3, |builder| two_layers(&builder)).unwrap();
            network.parameters.values().to_vec()
        };
        let one = values(1, "critic_1");
        assert_eq!(one.len(), (3 * 2 + 2) + (2 + 1));
        assert!(one[..8].iter().all(|value| value.abs() <= 1.0 / 3.0_f32.sqrt()), "{one:?}");
        assert_eq!(one, values(1, "critic_1"));
        assert_ne!(one, values(2, "critic_1"));
        assert_ne!(one, values(1, "critic_2"));
    }

    #[test]
    fn a_module_computes_with_the_parts_of_the_vector() {
        let variables = variables(|builder| two_layers(&builder).map(Some)).unwrap().unwrap();
        // First layer (1 2 3; 4 5 6) and bias (7, 8), second layer (9, 10) and bias 11.
        let flat: Vec<f32> = (1..=11_u8).map(f32::from).collect();
        let flat = Tensor::new(flat, &Device::Cpu).unwrap();
        let tensors = variables.iter().map(|part| part.view(&flat).unwrap()).collect();
        let network = two_layers(&builder(&variables, tensors, &Device::Cpu)).unwrap();
        let inputs = Tensor::new(&[[1.0_f32, 0.0, -1.0]], &Device::Cpu).unwrap();
        let output = network.forward(&inputs).unwrap().to_vec2::<f32>().unwrap();
        // 9 (1 - 3 + 7) + 10 (4 - 6 + 8) + 11.
        assert_eq!(output, [[116.0]]);
    }

    #[test]
    fn a_loss_without_a_gradient_names_the_network_and_the_remedy() {
        let build = |builder: VarBuilder<'_>| -> Result<Box<dyn Module>> {
            let first = linear(3, 2, &builder.pp("first"))?;
            let norm = candle_nn::layer_norm(2, 1e-5, builder.pp("norm"))?;
            Ok(Box::new(seq().add(first).add(norm)))
        };
        let host = draw(&ExperimentConfig::default(), "critic_1", 3, build).unwrap();
        let variables = variables(|builder| build(builder).map(Some)).unwrap();
        let network = DeviceNetwork::new("critic_1", &host, variables, &Device::Cpu).unwrap();
        let tensors = network.tensors(Of::Network).unwrap();
        let module = build(builder(&network.variables, tensors, &Device::Cpu)).unwrap();
        let inputs = Tensor::new(&[[1.0_f32, 0.0, -1.0]], &Device::Cpu).unwrap();
        let loss = module.forward(&inputs).unwrap().sum_all().unwrap();
        let error = network.gradient_of(&loss).unwrap_err().to_string();
        assert!(error.contains("critic_1") && error.contains("modules::layer_norm"), "{error}");
    }

    #[test]
    fn a_network_that_does_not_begin_with_a_linear_layer_is_refused() {
        let config = ExperimentConfig::default();
        let build = |builder: VarBuilder<'_>| -> Result<Box<dyn Module>> {
            Ok(Box::new(layer_norm(3, &builder)?))
        };
        let error = draw(&config, "critic_1", 3, build).unwrap_err().to_string();
        assert!(error.contains("critic_1 must begin with the weights, (3 columns)"), "{error}");
    }
}
