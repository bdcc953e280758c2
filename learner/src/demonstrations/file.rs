//! Reads a NumPy archive of steps and checks every number.

use std::collections::BTreeSet;
use std::path::Path;

use candle_core::npy::NpzTensors;
use candle_core::{DType, Tensor};
use dmprl_shared::policy::ActionScaling;
use dmprl_shared::spec::EnvSpec;

use super::{DemonstrationError, Steps};

/// An action written with 32 bits may lie so far outside of its bounds, as a share of their range.
const ROUNDING: f64 = 1e-5;
/// Rows of a file: a slip of a header must not ask for all memory.
const ROWS_MAX: usize = 1 << 31;

const KEYS: [&str; 6] =
    ["observations", "actions", "rewards", "next_observations", "terminated", "truncated"];

/// One array, in 64 bits.
struct Array {
    values: Vec<f64>,
    width: usize,
}

struct Archive<'a> {
    path: &'a Path,
    tensors: NpzTensors,
}

pub(super) fn read(
    path: &Path,
    spec: &EnvSpec,
    scaling: &ActionScaling,
) -> Result<Steps, DemonstrationError> {
    let unreadable = |error: candle_core::Error| DemonstrationError::Unreadable {
        file: path.to_owned(),
        reason: plain(&error),
    };
    let archive = Archive { path, tensors: NpzTensors::new(path).map_err(unreadable)? };
    archive.check_keys()?;
    let (o, a) = (spec.observation_len, spec.action_len);
    let rows = archive.rows()?;
    let name = |index: usize| spec.observation_name(index);
    let observations = archive.finite("observations", rows, Some(o), &name)?;
    let next_observations = archive.finite("next_observations", rows, Some(o), &name)?;
    let actions = archive.finite("actions", rows, Some(a), &|index| format!("entry {index}"))?;
    let rewards = archive.finite("rewards", rows, None, &|_| String::new())?;
    let steps = Steps {
        actions: archive.scaled(&actions, spec, scaling)?,
        observations: narrow(&observations),
        rewards: narrow(&rewards),
        next_observations: narrow(&next_observations),
        terminated: archive.flags("terminated", rows)?,
        truncated: archive.flags("truncated", rows)?,
    };
    archive.check_continuity(&steps, o)?;
    Ok(steps)
}

/// The error without the backtrace that candle may add.
fn plain(error: &candle_core::Error) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}

fn narrow(array: &Array) -> Vec<f32> {
    array.values.iter().map(|value| *value as f32).collect()
}

impl Archive<'_> {
    fn refuse(&self, key: String, expected: String, got: String) -> DemonstrationError {
        DemonstrationError::Array { file: self.path.to_owned(), key, expected, got }
    }

    fn check_keys(&self) -> Result<(), DemonstrationError> {
        let names: BTreeSet<&str> = self.tensors.names().into_iter().map(String::as_str).collect();
        match KEYS.iter().find(|key| !names.contains(*key)) {
            None => Ok(()),
            Some(key) => {
                let got = names.into_iter().collect::<Vec<_>>().join(", ");
                let expected = format!("arrays {}", KEYS.join(", "));
                Err(self.refuse((*key).to_owned(), expected, got))
            }
        }
    }

    fn shape(&self, key: &str) -> Result<Vec<usize>, DemonstrationError> {
        let shape = self.tensors.get_shape_and_dtype(key).map_err(|error| self.unreadable(&error));
        Ok(shape?.0.into_dims())
    }

    fn unreadable(&self, error: &candle_core::Error) -> DemonstrationError {
        DemonstrationError::Unreadable { file: self.path.to_owned(), reason: plain(error) }
    }

    /// N, which `rewards` says.
    fn rows(&self) -> Result<usize, DemonstrationError> {
        match self.shape("rewards")?[..] {
            [rows] if (1..=ROWS_MAX).contains(&rows) => Ok(rows),
            ref other => {
                Err(self.refuse("rewards".into(), "shape (N,), N > 0".into(), shown(other)))
            }
        }
    }

    fn array(
        &self,
        key: &str,
        rows: usize,
        width: Option<usize>,
    ) -> Result<Array, DemonstrationError> {
        let (got, expected) = (self.shape(key)?, [Some(rows), width]);
        let expected: Vec<usize> = expected.into_iter().flatten().collect();
        if got != expected {
            let expected = format!("shape {}", shown(&expected));
            return Err(self.refuse(key.to_owned(), expected, shown(&got)));
        }
        let values = self.tensors.get(key).and_then(|tensor| {
            let wide = |tensor: Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1();
            tensor.map_or_else(|| Ok(Vec::new()), wide)
        });
        let values = values.map_err(|error| self.unreadable(&error))?;
        Ok(Array { values, width: width.unwrap_or(1) })
    }

    /// An array of numbers that are finite in 32 bits, in which the learner keeps them.
    fn finite(
        &self,
        key: &str,
        rows: usize,
        width: Option<usize>,
        name: &dyn Fn(usize) -> String,
    ) -> Result<Array, DemonstrationError> {
        let array = self.array(key, rows, width)?;
        let wrong = array.values.iter().position(|value| !(*value as f32).is_finite());
        let Some(at) = wrong else { return Ok(array) };
        let (row, entry) = (at / array.width, name(at % array.width));
        let place = format!("{key}, row {row} {entry}").trim_end().to_owned();
        Err(self.refuse(place, "a finite 32-bit number".into(), array.values[at].to_string()))
    }

    fn flags(&self, key: &str, rows: usize) -> Result<Vec<bool>, DemonstrationError> {
        let array = self.array(key, rows, None)?;
        match array.values.iter().position(|&flag| flag != 0.0 && flag != 1.0) {
            None => Ok(array.values.iter().map(|&flag| flag == 1.0).collect()),
            Some(row) => {
                let got = array.values[row].to_string();
                Err(self.refuse(format!("{key}, row {row}"), "0 or 1".into(), got))
            }
        }
    }

    /// From the environment's units to u.
    fn scaled(
        &self,
        actions: &Array,
        spec: &EnvSpec,
        scaling: &ActionScaling,
    ) -> Result<Vec<f32>, DemonstrationError> {
        for (at, &action) in actions.values.iter().enumerate() {
            let (row, dimension) = (at / actions.width, at % actions.width);
            let (low, high) = (spec.action_low[dimension], spec.action_high[dimension]);
            let slack = ROUNDING * (high - low);
            if !(low - slack..=high + slack).contains(&action) {
                let place = format!("actions, row {row} entry {dimension}");
                let bounds = format!("the environment's own units, {low} to {high}");
                return Err(self.refuse(place, bounds, action.to_string()));
            }
        }
        let mut u = vec![0.0; actions.values.len()];
        scaling.invert(&actions.values, &mut u);
        Ok(u)
    }

    /// Inside an episode the observation after a step is the one before the next.
    fn check_continuity(&self, steps: &Steps, o: usize) -> Result<(), DemonstrationError> {
        for row in 0..steps.len() - 1 {
            if steps.is_end(row) {
                continue;
            }
            let after = &steps.next_observations[row * o..(row + 1) * o];
            let before = &steps.observations[(row + 1) * o..(row + 2) * o];
            if let Some(at) = (0..o).find(|&at| after[at] != before[at]) {
                let expected = format!(
                    "observations of row {}, as neither terminated nor truncated ends the episode \
                     in row {row}; entry {at} is {} there",
                    row + 1,
                    before[at]
                );
                let key = format!("next_observations, row {row}");
                return Err(self.refuse(key, expected, after[at].to_string()));
            }
        }
        Ok(())
    }
}

/// As Python writes a shape.
fn shown(shape: &[usize]) -> String {
    let numbers: Vec<String> = shape.iter().map(usize::to_string).collect();
    match numbers.as_slice() {
        [one] => format!("({one},)"),
        _ => format!("({})", numbers.join(", ")),
    }
}
