//! A policy on disk: safetensors, one tensor a weight matrix or bias, and who it is.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::Path;

use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::Policy;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use thiserror::Error;

/// Version of this format.
const FORMAT: &str = "dmprl-policy-1";

/// Why a policy file was refused.
#[derive(Debug, Error)]
pub enum PolicyFileError {
    /// Reading or writing failed.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: String,
        /// Why.
        cause: io::Error,
    },
    /// Not a safetensors file, or cut short.
    #[error("{path}: not a readable safetensors file, {cause}")]
    Format {
        /// The file.
        path: String,
        /// Why.
        cause: String,
    },
    /// A field or tensor that is missing or does not fit.
    #[error("{path}: {name} is {got}, expected {expected}")]
    Mismatch {
        /// The file.
        path: String,
        /// Which field or tensor.
        name: String,
        /// What fits.
        expected: String,
        /// What the file has.
        got: String,
    },
}

fn names(policy: &Policy) -> Vec<(String, Vec<usize>, std::ops::Range<usize>)> {
    let layers = policy.shape().layers().iter().enumerate();
    let network_len = policy.shape().parameters_len();
    let distribution = policy.learned_std().map(|learned| {
        let range = network_len..network_len + learned.len();
        ("actor.log_std".to_owned(), vec![learned.len()], range)
    });
    layers
        .flat_map(|(index, layer)| {
            [
                (
                    format!("actor.{index}.weight"),
                    vec![layer.outputs, layer.inputs],
                    layer.weights.clone(),
                ),
                (format!("actor.{index}.bias"), vec![layer.outputs], layer.bias.clone()),
            ]
        })
        .chain(distribution)
        .collect()
}

/// Writes a snapshot, first to a temporary name beside `path`.
///
/// # Errors
/// `Io` if writing fails; nothing is left at `path` then.
pub fn save(
    path: &Path,
    policy: &Policy,
    snapshot: &ParameterSnapshot,
) -> Result<(), PolicyFileError> {
    let io_error = |cause| PolicyFileError::Io { path: path.display().to_string(), cause };
    let format_error = |cause: safetensors::SafeTensorError| PolicyFileError::Format {
        path: path.display().to_string(),
        cause: cause.to_string(),
    };
    let mut tensors = Vec::new();
    for (name, shape, range) in names(policy) {
        let bytes = bytemuck::cast_slice(&snapshot.values[range]);
        let view = TensorView::new(Dtype::F32, shape, bytes).map_err(format_error)?;
        tensors.push((name, view));
    }
    let metadata = HashMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("architecture_hash".to_owned(), format!("{:016x}", snapshot.architecture_hash)),
        ("policy_version".to_owned(), snapshot.version.to_string()),
        ("env_steps".to_owned(), snapshot.env_steps.to_string()),
    ]);
    let bytes = safetensors::serialize(tensors, Some(metadata)).map_err(format_error)?;
    let temporary = path.with_extension("tmp");
    fs::write(&temporary, bytes)
        .and_then(|()| fs::File::open(&temporary)?.sync_all())
        .and_then(|()| fs::rename(&temporary, path))
        .map_err(io_error)
}

/// How strictly a file must match the policy it is loaded into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// The same architecture: configuration, DMP, task and sizes.
    Architecture,
    /// The same network sizes, for a warm start under another configuration.
    Sizes,
}

/// Reads a snapshot.
///
/// # Errors
/// If the file is unreadable, damaged or of another architecture.
pub fn load(
    path: &Path,
    policy: &Policy,
    strictness: Match,
) -> Result<ParameterSnapshot, PolicyFileError> {
    let shown = path.display().to_string();
    let bytes =
        fs::read(path).map_err(|cause| PolicyFileError::Io { path: shown.clone(), cause })?;
    let format_error = |cause: safetensors::SafeTensorError| PolicyFileError::Format {
        path: path.display().to_string(),
        cause: cause.to_string(),
    };
    let mismatch = |name: &str, expected: String, got: String| PolicyFileError::Mismatch {
        path: path.display().to_string(),
        name: name.to_owned(),
        expected,
        got,
    };
    let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(format_error)?;
    let empty = HashMap::new();
    let fields = metadata.metadata().as_ref().unwrap_or(&empty);
    let field = |name: &str| fields.get(name).cloned().unwrap_or_else(|| "missing".into());
    let mut expected = vec![("format", FORMAT.to_owned())];
    if strictness == Match::Architecture {
        expected.push(("architecture_hash", format!("{:016x}", policy.architecture_hash())));
    }
    for (name, expected) in expected {
        if field(name) != expected {
            return Err(mismatch(name, expected, field(name)));
        }
    }
    let number = |name: &str| {
        let text = field(name);
        text.parse::<u64>().map_err(|_| mismatch(name, "a whole number".into(), text))
    };
    let tensors = SafeTensors::deserialize(&bytes).map_err(format_error)?;
    let mut values = vec![0.0_f32; policy.parameters_len()];
    for (name, shape, range) in names(policy) {
        let tensor = tensors.tensor(&name).map_err(format_error)?;
        if tensor.shape() != shape || tensor.dtype() != Dtype::F32 {
            let got = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
            return Err(mismatch(&name, format!("F32 {shape:?}"), got));
        }
        bytemuck::cast_slice_mut(&mut values[range]).copy_from_slice(tensor.data());
    }
    if let Some(at) = values.iter().position(|value| !value.is_finite()) {
        return Err(mismatch("a parameter", "finite".into(), values[at].to_string()));
    }
    Ok(ParameterSnapshot {
        version: number("policy_version")?,
        env_steps: number("env_steps")?,
        architecture_hash: policy.architecture_hash(),
        values,
    })
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::ExperimentConfig;

    use super::*;
    use crate::learner::tests::spec;

    fn policy(keys: &[(&str, &str)]) -> Policy {
        let mut layers = dmprl_shared::config::Layers::new();
        for (key, value) in keys {
            layers.set("test", key, value).unwrap();
        }
        let config: ExperimentConfig = layers.finish().unwrap();
        Policy::new(&config, &spec()).unwrap()
    }

    #[test]
    fn a_stochastic_policy_keeps_its_standard_deviations() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("1.safetensors");
        let own = policy(&[("algorithm.name", "ndp"), ("algorithm.ndp.initial_log_std", "-0.5")]);
        let mut random = dmprl_shared::seeds::stream(1, "test", 0);
        let snapshot = ParameterSnapshot {
            version: 1,
            env_steps: 0,
            architecture_hash: own.architecture_hash(),
            values: own.initial_parameters(&mut random),
        };
        save(&path, &own, &snapshot).unwrap();
        let read = load(&path, &own, Match::Architecture).unwrap();
        assert_eq!(read, snapshot);
        assert_eq!(own.learned_std().unwrap().log_std(&read.values), [-0.5; 2]);
        assert_eq!(read.values.len(), own.shape().parameters_len() + 2);
    }

    #[test]
    fn a_policy_read_back_is_the_same_and_a_foreign_or_damaged_one_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("7.safetensors");
        let own = policy(&[]);
        let mut random = dmprl_shared::seeds::stream(1, "test", 0);
        let snapshot = ParameterSnapshot {
            version: 7,
            env_steps: 100,
            architecture_hash: own.architecture_hash(),
            values: own.initial_parameters(&mut random),
        };
        save(&path, &own, &snapshot).unwrap();
        assert_eq!(load(&path, &own, Match::Architecture).unwrap(), snapshot);

        let other = policy(&[("dmp.alpha_y", "8.0")]);
        let error = load(&path, &other, Match::Architecture).unwrap_err().to_string();
        assert!(error.contains("architecture_hash"), "{error}");
        assert_eq!(load(&path, &other, Match::Sizes).unwrap().values, snapshot.values);
        let wider = policy(&[("policy.hidden", "[256, 128]")]);
        let error = load(&path, &wider, Match::Sizes).unwrap_err().to_string();
        assert!(error.contains("actor.1.weight") && error.contains("[128, 256]"), "{error}");

        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let error = load(&path, &own, Match::Architecture).unwrap_err().to_string();
        assert!(error.contains("not a readable safetensors file"), "{error}");
    }
}
