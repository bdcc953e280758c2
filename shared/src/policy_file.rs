//! Policy files: safetensors with one tensor per weight matrix or bias, and a description.
//!
//! A file is sufficient to run the policy. Observation normalisation is folded into its tensors.
//! Its metadata contain the policy's description (environment, DMP, ranges, controller, start) as
//! JSON. The tensor `segment_map` is the DMP as one matrix, so that readers need no integrator.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::parameters::ParameterSnapshot;
use crate::policy::{Head, Policy, PolicyDescription};

/// Version of this format.
const FORMAT: &str = "dmprl-policy-1";
const FORMAT_KEY: &str = "format";
const HASH_KEY: &str = "architecture_hash";
const VERSION_KEY: &str = "policy_version";
const STEPS_KEY: &str = "env_steps";
const DESCRIPTION_KEY: &str = "description";
const CHECKSUM_KEY: &str = "checksum";
const ORIGIN_KEY: &str = "origin";
/// Map from (y0, yd0, g, w) to the samples of one dimension, (3K, 3+N).
const MAP: &str = "segment_map";

/// Why a policy file was rejected.
#[derive(Debug, Error)]
pub enum PolicyFileError {
    /// The file cannot be read.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: String,
        /// The error.
        cause: io::Error,
    },
    /// Not a safetensors file, or a truncated one.
    #[error("{path}: not a readable safetensors file, {cause}")]
    Format {
        /// The file.
        path: String,
        /// The error.
        cause: String,
    },
    /// A field or tensor is missing or wrong.
    #[error("{path}: {name} is {got}, expected {expected}")]
    Mismatch {
        /// The file.
        path: String,
        /// Name of the field or tensor.
        name: String,
        /// Expected value.
        expected: String,
        /// Actual value.
        got: String,
    },
}

/// Origin of a policy: run, task and results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Origin {
    /// Id of the run that trained it.
    pub run_id: String,
    /// The task's name.
    pub task: String,
    /// `run.seed`.
    pub seed: u64,
    /// Version of dmprl that wrote the file.
    pub dmprl_version: String,
    /// Git commit of that version, if known.
    pub git_commit: Option<String>,
    /// Mean return of its evaluation, if it was evaluated.
    pub return_mean: Option<f64>,
    /// Success rate of its evaluation, if the task reports success.
    pub success_rate: Option<f64>,
}

/// A policy with its parameters.
#[derive(Debug)]
pub struct OpenedPolicy {
    /// The architecture.
    pub policy: Policy,
    /// Its parameters.
    pub snapshot: ParameterSnapshot,
    /// Its origin; `None` in a run's own files.
    pub origin: Option<Origin>,
}

/// How well a file must match the policy that it is loaded into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// The same architecture: configuration, DMP, task and sizes.
    Architecture,
    /// The same network sizes, for a warm start under another configuration.
    Sizes,
}

/// Encodes a policy file.
///
/// - `origin`: origin of the policy, for files that leave their run's directory.
///
/// # Errors
/// `Format` if the parameters do not fit the policy.
pub fn encode(
    policy: &Policy,
    snapshot: &ParameterSnapshot,
    origin: Option<&Origin>,
) -> Result<Vec<u8>, PolicyFileError> {
    let path = Path::new("policy file");
    let view = |shape, numbers| {
        let view = TensorView::new(Dtype::F32, shape, bytemuck::cast_slice::<f32, u8>(numbers));
        view.map_err(|error| format_error(path, error))
    };
    let mut tensors = Vec::new();
    for (name, shape, range) in names(policy) {
        tensors.push((name, view(shape, &snapshot.values[range])?));
    }
    if let Head::Dmp(head) = policy.head() {
        let map = head.map();
        let shape = vec![map.sample_count(), map.input_count()];
        tensors.push((MAP.to_owned(), view(shape, map.matrix())?));
    }
    let json = |value: serde_json::Result<String>| value.map_err(|e| format_error(path, e));
    let description = json(serde_json::to_string(policy.description()))?;
    let mut metadata = HashMap::from([
        (FORMAT_KEY.to_owned(), FORMAT.to_owned()),
        (HASH_KEY.to_owned(), format!("{:016x}", snapshot.architecture_hash)),
        (VERSION_KEY.to_owned(), snapshot.version.to_string()),
        (STEPS_KEY.to_owned(), snapshot.env_steps.to_string()),
        (CHECKSUM_KEY.to_owned(), checksum(&description, &tensors)),
        (DESCRIPTION_KEY.to_owned(), description),
    ]);
    if let Some(origin) = origin {
        metadata.insert(ORIGIN_KEY.to_owned(), json(serde_json::to_string(origin))?);
    }
    safetensors::serialize(tensors, Some(metadata)).map_err(|e| format_error(path, e))
}

/// Returns the CRC-32 of the description and of the tensors' bytes, in the order of their names.
fn checksum(description: &str, tensors: &[(String, TensorView<'_>)]) -> String {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(description.as_bytes());
    let mut sorted: Vec<_> = tensors.iter().collect();
    sorted.sort_by(|(a, _), (b, _)| a.cmp(b));
    sorted.iter().for_each(|(_, tensor)| hasher.update(tensor.data()));
    format!("{:08x}", hasher.finalize())
}

/// Reads a snapshot for an existing policy.
///
/// # Errors
/// If the file is unreadable, corrupted or of another architecture.
pub fn load(
    path: &Path,
    policy: &Policy,
    strictness: Match,
) -> Result<ParameterSnapshot, PolicyFileError> {
    let bytes = read(path)?;
    Contents::new(path, &bytes)?.snapshot(policy, strictness)
}

/// Reads a policy and its parameters.
///
/// # Errors
/// If the file is unreadable or corrupted, or so old that it has no description.
pub fn open(path: &Path) -> Result<OpenedPolicy, PolicyFileError> {
    let bytes = read(path)?;
    let contents = Contents::new(path, &bytes)?;
    let Some(text) = contents.fields.get(DESCRIPTION_KEY) else {
        let expected = "a policy description; write the file again with dmprl export RUN";
        return Err(contents.mismatch(DESCRIPTION_KEY, expected.into(), "missing".into()));
    };
    let invalid = |name, error: &dyn std::error::Error| {
        let expected = "one that this version of dmprl supports";
        contents.mismatch(name, expected.into(), format!("invalid ({error})"))
    };
    let description: PolicyDescription =
        serde_json::from_str(text).map_err(|error| invalid(DESCRIPTION_KEY, &error))?;
    let policy = description.build().map_err(|error| invalid(DESCRIPTION_KEY, &error))?;
    let origin = contents.fields.get(ORIGIN_KEY).map(|text| serde_json::from_str(text));
    let origin = origin.transpose().map_err(|error| invalid(ORIGIN_KEY, &error))?;
    let snapshot = contents.snapshot(&policy, Match::Architecture)?;
    contents.expect(CHECKSUM_KEY, checksum(text, &contents.tensors.tensors()))?;
    Ok(OpenedPolicy { policy, snapshot, origin })
}

fn read(path: &Path) -> Result<Vec<u8>, PolicyFileError> {
    let shown = path.display().to_string();
    fs::read(path).map_err(|cause| PolicyFileError::Io { path: shown, cause })
}

fn format_error(path: &Path, cause: impl std::fmt::Display) -> PolicyFileError {
    PolicyFileError::Format { path: path.display().to_string(), cause: cause.to_string() }
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

/// Contents of a file in the supported format.
struct Contents<'a> {
    path: &'a Path,
    fields: HashMap<String, String>,
    tensors: SafeTensors<'a>,
}

impl<'a> Contents<'a> {
    fn new(path: &'a Path, bytes: &'a [u8]) -> Result<Self, PolicyFileError> {
        let (_, metadata) =
            SafeTensors::read_metadata(bytes).map_err(|error| format_error(path, error))?;
        let fields = metadata.metadata().clone().unwrap_or_default();
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| format_error(path, error))?;
        let contents = Self { path, fields, tensors };
        contents.expect(FORMAT_KEY, FORMAT.to_owned())?;
        Ok(contents)
    }

    fn snapshot(
        &self,
        policy: &Policy,
        strictness: Match,
    ) -> Result<ParameterSnapshot, PolicyFileError> {
        if strictness == Match::Architecture {
            self.expect(HASH_KEY, format!("{:016x}", policy.architecture_hash()))?;
        }
        let mut tensors = Vec::new();
        for (name, shape, range) in names(policy) {
            let tensor = self.tensors.tensor(&name).map_err(|e| format_error(self.path, e))?;
            if tensor.shape() != shape || tensor.dtype() != Dtype::F32 {
                let got = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
                return Err(self.mismatch(&name, format!("F32 {shape:?}"), got));
            }
            tensors.push((tensor, range));
        }
        // Allocates only after the shapes have been checked against the file, because the
        // description of a corrupted file may have any size.
        let mut values = vec![0.0_f32; policy.parameters_len()];
        for (tensor, range) in tensors {
            bytemuck::cast_slice_mut(&mut values[range]).copy_from_slice(tensor.data());
        }
        if let Some(at) = values.iter().position(|value| !value.is_finite()) {
            return Err(self.mismatch("a parameter", "finite".into(), values[at].to_string()));
        }
        Ok(ParameterSnapshot {
            version: self.number(VERSION_KEY)?,
            env_steps: self.number(STEPS_KEY)?,
            architecture_hash: policy.architecture_hash(),
            values,
        })
    }

    fn field(&self, name: &str) -> String {
        self.fields.get(name).cloned().unwrap_or_else(|| "missing".into())
    }

    fn expect(&self, name: &str, expected: String) -> Result<(), PolicyFileError> {
        let got = self.field(name);
        if got == expected { Ok(()) } else { Err(self.mismatch(name, expected, got)) }
    }

    fn number(&self, name: &str) -> Result<u64, PolicyFileError> {
        let text = self.field(name);
        text.parse().map_err(|_| self.mismatch(name, "a whole number".into(), text))
    }

    fn mismatch(&self, name: &str, expected: String, got: String) -> PolicyFileError {
        let path = self.path.display().to_string();
        PolicyFileError::Mismatch { path, name: name.to_owned(), expected, got }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{ExperimentConfig, Layers};
    use crate::spec::EnvSpec;

    fn spec() -> EnvSpec {
        EnvSpec {
            id: "Test-v0".into(),
            observation_len: 4,
            action_len: 2,
            action_low: vec![-1.0, 0.0],
            action_high: vec![1.0, 3.0],
            control_dt_s: 0.1,
            episode_steps: 50,
            observation_names: Vec::new(),
        }
    }

    fn policy(keys: &[(&str, &str)]) -> Policy {
        let mut layers = Layers::new();
        for (key, value) in keys {
            layers.set("test", key, value).unwrap();
        }
        let config: ExperimentConfig = layers.finish().unwrap();
        Policy::new(&config, &spec()).unwrap()
    }

    #[test]
    fn stochastic_policy_keeps_its_standard_deviations() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("1.safetensors");
        let own = policy(&[("algorithm.name", "ndp"), ("algorithm.ndp.initial_log_std", "-0.5")]);
        let mut random = crate::seeds::stream(1, "test", 0);
        let snapshot = ParameterSnapshot {
            version: 1,
            env_steps: 0,
            architecture_hash: own.architecture_hash(),
            values: own.initial_parameters(&mut random),
        };
        fs::write(&path, encode(&own, &snapshot, None).unwrap()).unwrap();
        let read = load(&path, &own, Match::Architecture).unwrap();
        assert_eq!(read, snapshot);
        assert_eq!(own.learned_std().unwrap().log_std(&read.values), [-0.5; 2]);
        assert_eq!(read.values.len(), own.shape().parameters_len() + 2);
    }

    #[test]
    fn policy_survives_a_round_trip_and_other_or_corrupted_files_are_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("7.safetensors");
        let own = policy(&[]);
        let mut random = crate::seeds::stream(1, "test", 0);
        let snapshot = ParameterSnapshot {
            version: 7,
            env_steps: 100,
            architecture_hash: own.architecture_hash(),
            values: own.initial_parameters(&mut random),
        };
        fs::write(&path, encode(&own, &snapshot, None).unwrap()).unwrap();
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

    fn saved(keys: &[(&str, &str)], path: &Path) -> (Policy, ParameterSnapshot, Origin) {
        let own = policy(keys);
        let mut random = crate::seeds::stream(1, "test", 0);
        let snapshot = ParameterSnapshot {
            version: 3,
            env_steps: 100,
            architecture_hash: own.architecture_hash(),
            values: own.initial_parameters(&mut random),
        };
        let origin = Origin {
            run_id: "00000000000000ab".into(),
            task: "test".into(),
            seed: 1,
            dmprl_version: "0.1.0".into(),
            git_commit: None,
            return_mean: Some(-4.25),
            success_rate: None,
        };
        fs::write(path, encode(&own, &snapshot, Some(&origin)).unwrap()).unwrap();
        (own, snapshot, origin)
    }

    #[test]
    fn policy_is_restored_from_the_file_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.safetensors");
        let sources =
            "[{ cos = 0, sin = 1, velocity = 2 }, { index = 3, velocity = 2, scale = -1.0 }]";
        for keys in [
            &[][..],
            &[("policy.kind", "mlp"), ("algorithm.name", "sac")],
            &[("algorithm.name", "ndp"), ("policy.controller", "position")],
            &[("policy.start", "carry"), ("dmp.alpha_y", "12.5"), ("policy.rho", "free")],
            &[("policy.start", "observed"), ("task.start_sources", sources)],
        ] {
            let (own, snapshot, origin) = saved(keys, &path);
            let opened = open(&path).unwrap();
            assert_eq!(opened.policy.architecture_hash(), own.architecture_hash(), "{keys:?}");
            assert_eq!(opened.policy.description(), own.description());
            assert_eq!((opened.snapshot, opened.origin), (snapshot, Some(origin)));
        }
    }

    #[test]
    fn missing_or_invalid_description_is_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.safetensors");
        let error_after_replacing = |from: &str, to: &str| {
            saved(&[], &path);
            let mut bytes = fs::read(&path).unwrap();
            let at = bytes.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
            // The header's length must not change.
            bytes[at..at + from.len()].copy_from_slice(format!("{to:<0$}", from.len()).as_bytes());
            fs::write(&path, bytes).unwrap();
            open(&path).unwrap_err().to_string()
        };
        let error = error_after_replacing("\"description\":", "\"descripti--\":");
        assert!(error.contains("description is missing") && error.contains("dmprl export"));
        let hidden = "\\\"hidden\\\":[256,256]";
        let error = error_after_replacing(hidden, &hidden.replace("256,256", "0,99999"));
        assert!(error.contains("policy.hidden"), "{error}");
        let error = error_after_replacing(hidden, &hidden.replace("256,256", "256,255"));
        assert!(error.contains("architecture_hash"), "{error}");
        // The same parameters, but a different function.
        let range = "\\\"goal_range\\\":1.0";
        let error = error_after_replacing(range, &range.replace("1.0", "2.0"));
        assert!(error.contains("architecture_hash"), "{error}");
        let dims = "\\\"action_len\\\":2";
        let error = error_after_replacing(dims, &dims.replace('2', "9"));
        assert!(error.contains("action_low has 2 entries, expected 9"), "{error}");
        // A flipped bit that leaves a valid number.
        saved(&[], &path);
        let mut bytes = fs::read(&path).unwrap();
        let last = bytes.len() - 1;
        bytes[last] ^= 1;
        fs::write(&path, bytes).unwrap();
        let error = open(&path).unwrap_err().to_string();
        assert!(error.contains("checksum"), "{error}");
    }
}
