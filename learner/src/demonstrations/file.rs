//! Reads a NumPy archive of recorded steps and checks every number.

use std::collections::BTreeSet;
use std::path::Path;

use candle_core::npy::NpzTensors;
use candle_core::{DType, Tensor};
use dmprl_shared::policy::ActionScaling;
use dmprl_shared::spec::EnvSpec;

use super::{Demonstration, DemonstrationError};

/// Tolerance of actions beyond their bounds, as a share of their range, for rounding to 32 bits.
const ROUNDING: f64 = 1e-5;
/// Maximum rows of a file, so that a damaged header does not exhaust the memory.
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

/// Reads and checks the file at `path`.
pub(super) fn read(
    path: &Path,
    spec: &EnvSpec,
    scaling: &ActionScaling,
) -> Result<Demonstration, DemonstrationError> {
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
    let steps = Demonstration {
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

/// Returns the error without the backtrace that candle may add.
fn plain(error: &candle_core::Error) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}

fn narrow(array: &Array) -> Vec<f32> {
    array.values.iter().map(|value| *value as f32).collect()
}

impl Archive<'_> {
    fn invalid(&self, key: String, expected: String, got: String) -> DemonstrationError {
        DemonstrationError::Array { file: self.path.to_owned(), key, expected, got }
    }

    fn check_keys(&self) -> Result<(), DemonstrationError> {
        let names: BTreeSet<&str> = self.tensors.names().into_iter().map(String::as_str).collect();
        match KEYS.iter().find(|key| !names.contains(*key)) {
            None => Ok(()),
            Some(key) => {
                let got = names.into_iter().collect::<Vec<_>>().join(", ");
                let expected = format!("arrays {}", KEYS.join(", "));
                Err(self.invalid((*key).to_owned(), expected, got))
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

    /// Returns N, the length of `rewards`.
    fn rows(&self) -> Result<usize, DemonstrationError> {
        match self.shape("rewards")?[..] {
            [rows] if (1..=ROWS_MAX).contains(&rows) => Ok(rows),
            ref other => {
                Err(self.invalid("rewards".into(), "shape (N,), N > 0".into(), shown(other)))
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
            return Err(self.invalid(key.to_owned(), expected, shown(&got)));
        }
        let values = self.tensors.get(key).and_then(|tensor| {
            let wide = |tensor: Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1();
            tensor.map_or_else(|| Ok(Vec::new()), wide)
        });
        let values = values.map_err(|error| self.unreadable(&error))?;
        Ok(Array { values, width: width.unwrap_or(1) })
    }

    /// Reads an array whose numbers must be finite in 32 bits, as the learner stores them.
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
        Err(self.invalid(place, "a finite 32-bit number".into(), array.values[at].to_string()))
    }

    fn flags(&self, key: &str, rows: usize) -> Result<Vec<bool>, DemonstrationError> {
        let array = self.array(key, rows, None)?;
        match array.values.iter().position(|&flag| flag != 0.0 && flag != 1.0) {
            None => Ok(array.values.iter().map(|&flag| flag == 1.0).collect()),
            Some(row) => {
                let got = array.values[row].to_string();
                Err(self.invalid(format!("{key}, row {row}"), "0 or 1".into(), got))
            }
        }
    }

    /// Converts actions from the environment's units to u.
    fn scaled(
        &self,
        actions: &Array,
        spec: &EnvSpec,
        scaling: &ActionScaling,
    ) -> Result<Vec<f32>, DemonstrationError> {
        for (at, &action) in actions.values.iter().enumerate() {
            let (row, dimension) = (at / actions.width, at % actions.width);
            let [low, high] = scaling.bounds(dimension);
            let slack = ROUNDING * (high - low);
            if !(low - slack..=high + slack).contains(&action) {
                let place = format!("actions, row {row} entry {dimension}");
                let mut bounds = format!("the environment's own units, {low} to {high}");
                if high < spec.action_high[dimension] - slack {
                    bounds.push_str(" (all of its range: --set policy.action_range=1)");
                }
                return Err(self.invalid(place, bounds, action.to_string()));
            }
        }
        let mut u = vec![0.0; actions.values.len()];
        scaling.invert(&actions.values, &mut u);
        Ok(u)
    }

    /// Checks that the observation after a step is the one before the next, within an episode.
    fn check_continuity(&self, steps: &Demonstration, o: usize) -> Result<(), DemonstrationError> {
        for row in 0..steps.len() - 1 {
            if steps.is_end(row) {
                continue;
            }
            let after = &steps.next_observations[row * o..(row + 1) * o];
            let before = &steps.observations[(row + 1) * o..(row + 2) * o];
            if let Some(at) = (0..o).find(|&at| after[at] != before[at]) {
                let expected = format!(
                    "observations of row {}, because the episode does not end in row {row} \
                     (neither terminated nor truncated); entry {at} is {} there",
                    row + 1,
                    before[at]
                );
                let key = format!("next_observations, row {row}");
                return Err(self.invalid(key, expected, after[at].to_string()));
            }
        }
        Ok(())
    }
}

/// Formats a shape like Python.
fn shown(shape: &[usize]) -> String {
    let numbers: Vec<String> = shape.iter().map(usize::to_string).collect();
    match numbers.as_slice() {
        [one] => format!("({one},)"),
        _ => format!("({})", numbers.join(", ")),
    }
}
