//! Reads and writes networks, targets and optimiser moments as one safetensors file.

use std::borrow::Cow;

use safetensors::tensor::{Dtype, SafeTensors, View};

use crate::finite::{self, NotFiniteParameter};
use crate::learner::{Learner, PolicyAverage};
use crate::parameters::Parameters;

/// A flat tensor to be written.
struct Flat {
    len: usize,
    values: Vec<f32>,
}

impl View for Flat {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        std::slice::from_ref(&self.len)
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(bytemuck::cast_slice(&self.values))
    }

    fn data_len(&self) -> usize {
        self.values.len() * size_of::<f32>()
    }
}

/// Checks the networks, their targets and the moments of their optimisers.
///
/// # Errors
/// The first value that is NaN or infinite.
pub(super) fn check_finite(learner: &Learner) -> Result<(), NotFiniteParameter> {
    for (name, network) in learner.networks() {
        let moments = &network.adam.moments;
        let target = network.target.as_ref().map(Parameters::values);
        let parts = [
            Some(network.parameters.values()),
            target,
            Some(&moments.first),
            Some(&moments.second),
        ];
        for (part, values) in PARTS.iter().zip(parts) {
            finite::check(values.unwrap_or_default(), || format!("{name}.{part}"))?;
        }
    }
    Ok(())
}

/// Returns the file's contents.
pub(super) fn bytes(learner: &Learner) -> Result<Vec<u8>, String> {
    let mut tensors = Vec::new();
    for (name, network) in learner.networks() {
        let parameters = network.parameters.values().to_vec();
        let target = network.target.as_ref().map(|target| target.values().to_vec());
        let moments = &network.adam.moments;
        let parts =
            [Some(parameters), target, Some(moments.first.clone()), Some(moments.second.clone())];
        for (part, values) in PARTS.iter().zip(parts) {
            let Some(values) = values else { continue };
            tensors.push((format!("{name}.{part}"), Flat { len: values.len(), values }));
        }
    }
    let average = learner.average.as_ref().map_or(&[][..], PolicyAverage::values);
    if !average.is_empty() {
        tensors.push((AVERAGE.to_owned(), Flat { len: average.len(), values: average.to_vec() }));
    }
    safetensors::serialize(tensors, None).map_err(|error| error.to_string())
}

/// Suffixes of a network's tensors.
const PARTS: [&str; 4] = ["network", "target", "adam_first", "adam_second"];
/// The average of the newest policies. Checkpoints of older versions do not have it.
const AVERAGE: &str = "policy.average";

/// Restores the networks from a file's contents.
pub(super) fn restore(bytes: &[u8], learner: &mut Learner) -> Result<(), String> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
    let read = |name: String, len: usize| -> Result<Vec<f32>, String> {
        let tensor = tensors.tensor(&name).map_err(|error| format!("{name}: {error}"))?;
        if tensor.dtype() != Dtype::F32 || tensor.shape() != [len] {
            let (dtype, shape) = (tensor.dtype(), tensor.shape());
            return Err(format!("{name} is {dtype:?} {shape:?}, expected F32 [{len}]"));
        }
        // The bytes may not be aligned for f32.
        let chunks = tensor.data().as_chunks::<4>().0;
        let values: Vec<f32> = chunks.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        finite::check(&values, || name).map_err(|error| error.to_string())?;
        Ok(values)
    };
    let policy_len = learner.policy().parameters_len();
    if let Some(average) = &mut learner.average
        && tensors.names().contains(&AVERAGE)
    {
        average.restore(read(AVERAGE.to_owned(), policy_len)?);
    }
    let read = |name: &str, part: &str, len| read(format!("{name}.{part}"), len);
    learner.for_each_network(|name, network| {
        let len = network.adam.moments.first.len();
        let set = |parameters: &mut Parameters, part| {
            parameters.set(&read(name, part, len)?).map_err(|error| error.to_string())
        };
        set(&mut network.parameters, PARTS[0])?;
        if let Some(target) = &mut network.target {
            set(target, PARTS[1])?;
        }
        network.adam.moments.first = read(name, PARTS[2], len)?;
        network.adam.moments.second = read(name, PARTS[3], len)?;
        Ok(())
    })
}
