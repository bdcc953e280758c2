//! Policy files: safetensors with one tensor per weight matrix or bias, and a description.
//!
//! A file is sufficient to run the policy. Observation normalisation is folded into its tensors.
//! Its metadata contain the policy's description (environment, DMP, ranges, controller, start) as
//! JSON. The tensor `segment_map` is the DMP as one matrix, so that readers need no integrator.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::parameters::ParameterSnapshot;
use crate::policy::{Head, Hold, Policy, PolicyDescription};

/// Version of the format of a file without a hold.
const FORMAT: &str = "dmprl-policy-1";
/// Version of the format of a file with a hold. Earlier programs reject it, because they would hold
/// the robot with another action.
const FORMAT_WITH_HOLD: &str = "dmprl-policy-2";
/// First byte of a file's header, after the header's length.
const HEADER_START: usize = 8;
const FORMAT_KEY: &str = "format";
const HASH_KEY: &str = "architecture_hash";
const VERSION_KEY: &str = "policy_version";
const STEPS_KEY: &str = "env_steps";
const DESCRIPTION_KEY: &str = "description";
const CHECKSUM_KEY: &str = "checksum";
const ORIGIN_KEY: &str = "origin";
const HOLD_KEY: &str = "hold";
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
    /// The command that holds the robot, if the export stated it.
    pub hold: Option<Hold>,
}

/// How well a file must match the policy that it is loaded into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// The same architecture: configuration, DMP, task and sizes.
    Architecture,
    /// The same network sizes and share of the action range, for a warm start under another
    /// configuration.
    Sizes,
}

/// Encodes a policy file.
///
/// - `origin`: origin of the policy, for files that leave their run's directory.
/// - `hold`: the command that holds the robot, for files that drive one.
///
/// # Errors
/// `Format` if the parameters do not fit the policy.
pub fn encode(
    policy: &Policy,
    snapshot: &ParameterSnapshot,
    origin: Option<&Origin>,
    hold: Option<&Hold>,
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
    let hold = hold.map(|hold| json(serde_json::to_string(hold))).transpose()?;
    let format = if hold.is_some() { FORMAT_WITH_HOLD } else { FORMAT };
    let mut metadata = HashMap::from([
        (FORMAT_KEY.to_owned(), format.to_owned()),
        (HASH_KEY.to_owned(), format!("{:016x}", snapshot.architecture_hash)),
        (VERSION_KEY.to_owned(), snapshot.version.to_string()),
        (STEPS_KEY.to_owned(), snapshot.env_steps.to_string()),
        (CHECKSUM_KEY.to_owned(), checksum(&description, hold.as_deref(), &tensors)),
        (DESCRIPTION_KEY.to_owned(), description),
    ]);
    if let Some(hold) = hold {
        metadata.insert(HOLD_KEY.to_owned(), hold);
    }
    if let Some(origin) = origin {
        metadata.insert(ORIGIN_KEY.to_owned(), json(serde_json::to_string(origin))?);
    }
    let mut bytes =
        safetensors::serialize(tensors, Some(metadata)).map_err(|e| format_error(path, e))?;
    let (length, _) = SafeTensors::read_metadata(&bytes).map_err(|e| format_error(path, e))?;
    sort_header(&mut bytes[HEADER_START..][..length]).map_err(|e| format_error(path, e))?;
    Ok(bytes)
}

/// Sorts a file's header by names, so that equal policies have equal files. The crate writes the
/// metadata in an order that changes from call to call.
fn sort_header(header: &mut [u8]) -> serde_json::Result<()> {
    let fields: BTreeMap<&str, BTreeMap<&str, serde_json::Value>> = serde_json::from_slice(header)?;
    let sorted = serde_json::to_vec(&fields)?;
    let (json, padding) = header.split_at_mut(sorted.len());
    json.copy_from_slice(&sorted);
    padding.fill(b' ');
    Ok(())
}

/// Returns the CRC-32 of the description, of the hold, and of the tensors' bytes in the order of
/// their names.
fn checksum(description: &str, hold: Option<&str>, tensors: &[(String, TensorView<'_>)]) -> String {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(description.as_bytes());
    hasher.update(hold.unwrap_or_default().as_bytes());
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
    let policy = Policy::new(description).map_err(|error| invalid(DESCRIPTION_KEY, &error))?;
    let origin = contents.fields.get(ORIGIN_KEY).map(|text| serde_json::from_str(text));
    let origin = origin.transpose().map_err(|error| invalid(ORIGIN_KEY, &error))?;
    let snapshot = contents.snapshot(&policy, Match::Architecture)?;
    let held = contents.fields.get(HOLD_KEY).map(String::as_str);
    contents.expect(CHECKSUM_KEY, checksum(text, held, &contents.tensors.tensors()))?;
    let hold: Option<Hold> =
        held.map(serde_json::from_str).transpose().map_err(|error| invalid(HOLD_KEY, &error))?;
    if let Some(hold) = &hold {
        hold.action(&policy.description().spec).map_err(|error| invalid(HOLD_KEY, &error))?;
    }
    Ok(OpenedPolicy { policy, snapshot, origin, hold })
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
        let has_hold = contents.fields.contains_key(HOLD_KEY);
        let format = if has_hold { FORMAT_WITH_HOLD } else { FORMAT };
        contents.expect(FORMAT_KEY, format.to_owned())?;
        Ok(contents)
    }

    fn snapshot(
        &self,
        policy: &Policy,
        strictness: Match,
    ) -> Result<ParameterSnapshot, PolicyFileError> {
        if strictness == Match::Architecture {
            self.expect(HASH_KEY, format!("{:016x}", policy.architecture_hash()))?;
        } else {
            self.check_action_range(policy)?;
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
            settled: false,
            values,
        })
    }

    /// Checks that the file's policy uses the same share of the action range: otherwise all its
    /// actions would be scaled.
    fn check_action_range(&self, policy: &Policy) -> Result<(), PolicyFileError> {
        let text = self.fields.get(DESCRIPTION_KEY).map_or("null", String::as_str);
        let description: serde_json::Value =
            serde_json::from_str(text).map_err(|error| format_error(self.path, error))?;
        // Older files have no such key.
        let got = description["policy"]["action_range"].as_f64().unwrap_or(1.0);
        let expected = policy.description().policy.action_range;
        if got == expected {
            return Ok(());
        }
        let expected = format!("{expected}, as in this run (or --set policy.action_range={got})");
        Err(self.mismatch("policy.action_range", expected, got.to_string()))
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
mod tests;
