//! Stores the numbers of a JSON Lines file in columns, and returns curves of limited length.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

/// Maximum number of rows. Beyond it every other row is dropped, repeatedly.
const ROWS_MAX: usize = 50_000;
/// Maximum number of columns, about three times as many as `metrics.jsonl` has.
const COLUMNS_MAX: usize = 128;
/// Significant digits in a curve. More would be invisible and enlarge the response.
const DIGITS: i32 = 6;

/// Columns of numbers. Missing and null values are NaN.
#[derive(Debug, Default)]
pub struct Table {
    columns: BTreeMap<String, Vec<f64>>,
    rows: usize,
    /// Only every `stride`-th row of the file is kept.
    stride: usize,
    seen: usize,
}

/// Points of a curve.
#[derive(Debug, Default, PartialEq, Serialize)]
pub struct Curve {
    /// Environment steps of the points.
    pub env_steps: Vec<f64>,
    /// Training time of the points [s].
    pub wall_s: Vec<f64>,
    /// Values of the points, always finite.
    pub values: Vec<f64>,
}

impl Table {
    /// Adds a row; returns true if rows were dropped, which gives the remaining ones new indices.
    pub fn push(&mut self, row: &Value) -> bool {
        self.stride = self.stride.max(1);
        self.seen += 1;
        if !(self.seen - 1).is_multiple_of(self.stride) {
            return false;
        }
        let mut numbers = Vec::new();
        flatten(row, String::new(), &mut numbers);
        for (name, value) in numbers {
            if self.columns.len() >= COLUMNS_MAX && !self.columns.contains_key(&name) {
                continue;
            }
            let column = self.columns.entry(name).or_default();
            column.resize(self.rows, f64::NAN);
            column.push(value);
        }
        self.rows += 1;
        self.columns.values_mut().for_each(|column| column.resize(self.rows, f64::NAN));
        let full = self.rows >= ROWS_MAX;
        if full {
            self.halve();
        }
        full
    }

    /// Number of rows kept.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Returns the curve of a column from row `from` on, with about `points_max` points at most.
    /// Longer curves are reduced to the minimum and maximum of each interval, so that spikes are
    /// kept.
    #[must_use]
    pub fn curve(&self, name: &str, from: usize, points_max: usize) -> Curve {
        let Some(column) = self.columns.get(name) else { return Curve::default() };
        let rows: Vec<usize> = (from..self.rows).filter(|&row| column[row].is_finite()).collect();
        let chosen = if rows.len() <= points_max {
            rows
        } else {
            let interval = rows.len().div_ceil((points_max / 2).max(1));
            rows.chunks(interval).flat_map(|rows| extremes(rows, column)).collect()
        };
        let of = |name: &str| -> Vec<f64> {
            let column = self.columns.get(name);
            let at = |&row: &usize| column.map_or(f64::NAN, |column| column[row]);
            chosen.iter().map(at).map(rounded).collect()
        };
        Curve { env_steps: of("env_steps"), wall_s: of("wall_s"), values: of(name) }
    }

    fn halve(&mut self) {
        for column in self.columns.values_mut() {
            *column = column.iter().copied().step_by(2).collect();
        }
        self.rows = self.rows.div_ceil(2);
        self.stride *= 2;
    }
}

/// Returns the rows of the minimum and the maximum, in ascending order.
fn extremes(rows: &[usize], column: &[f64]) -> Vec<usize> {
    let by_value = |a: &&usize, b: &&usize| column[**a].total_cmp(&column[**b]);
    let low = rows.iter().min_by(by_value).copied();
    let high = rows.iter().max_by(by_value).copied();
    let mut both: Vec<usize> = low.into_iter().chain(high).collect();
    both.sort_unstable();
    both.dedup();
    both
}

/// Collects the numbers of an object; those of nested objects are named `outer.inner`.
fn flatten(value: &Value, name: String, numbers: &mut Vec<(String, f64)>) {
    match value {
        Value::Number(number) => numbers.extend(number.as_f64().map(|number| (name, number))),
        Value::Object(inner) => {
            for (key, value) in inner {
                let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                flatten(value, name, numbers);
            }
        }
        _ => {}
    }
}

/// Rounds to [`DIGITS`] significant digits; integers are unchanged.
pub fn rounded(value: f64) -> f64 {
    if value == 0.0 || !value.is_finite() || value.fract() == 0.0 {
        return value;
    }
    let digits = (DIGITS - 1 - value.abs().log10().floor() as i32).clamp(0, 300);
    let scale = 10_f64.powi(digits);
    let scaled = (value * scale).round() / scale;
    if scaled.is_finite() { scaled } else { value }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn table(values: impl IntoIterator<Item = Value>) -> Table {
        let mut table = Table::default();
        for (index, value) in values.into_iter().enumerate() {
            let row = json!({"env_steps": index, "wall_s": index, "loss": value});
            table.push(&row);
        }
        table
    }

    #[test]
    fn curve_skips_rows_without_a_value() {
        let table = table([json!(1.0), json!(null), json!(3.123_456_789)]);
        let curve = table.curve("loss", 0, 10);
        assert_eq!(curve.env_steps, [0.0, 2.0]);
        assert_eq!(curve.values, [1.0, 3.12346]);
        assert_eq!(table.curve("loss", 1, 10).values, [3.12346]);
        assert_eq!(table.curve("unknown", 0, 10), Curve::default());
    }

    #[test]
    fn spike_survives_the_reduction_of_a_curve() {
        let mut values = vec![json!(0.0); 10_000];
        values[6_789] = json!(42.0);
        let curve = table(values).curve("loss", 0, 100);
        assert!(curve.values.len() <= 101, "{}", curve.values.len());
        let at = curve.values.iter().position(|value| *value == 42.0).expect("the spike");
        assert_eq!(curve.env_steps[at], 6_789.0);
        assert!(curve.env_steps.is_sorted());
    }

    #[test]
    fn column_may_appear_late_and_nested_keys_are_joined_by_dots() {
        let mut table = Table::default();
        table.push(&json!({"env_steps": 1, "wall_s": 1.0}));
        table.push(&json!({"env_steps": 2, "wall_s": 2.0, "rejected": {"run": 3}}));
        let curve = table.curve("rejected.run", 0, 10);
        assert_eq!((curve.env_steps, curve.values), (vec![2.0], vec![3.0]));
    }

    #[test]
    fn long_run_keeps_a_bounded_number_of_evenly_spaced_rows() {
        let mut table = Table::default();
        let mut dropped = 0;
        let rows = ROWS_MAX * 3;
        for index in 0..rows {
            let row = json!({"env_steps": index, "wall_s": index, "loss": index});
            dropped += usize::from(table.push(&row));
        }
        assert_eq!(dropped, 2);
        assert!(table.rows() < ROWS_MAX);
        let steps = table.curve("loss", 0, usize::MAX).env_steps;
        assert_eq!(steps[0], 0.0);
        assert!(steps.windows(2).all(|pair| pair[1] - pair[0] == 4.0));
        assert!(steps[steps.len() - 1] >= (rows - 4) as f64);
    }
}
