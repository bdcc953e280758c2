//! Parses the sweep file, a TOML file in which unknown keys are errors.

use std::path::Path;

use serde::Deserialize;
use toml::{Table, Value};

use super::Search;
use crate::failure::wrong_use;

/// Maximum size of a sweep file, which usually has a few kilobytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// A sweep: every task with every method, at every point of the grid or of a search, with every
/// seed.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweepFile {
    /// `run.seed` of each repetition.
    pub seeds: Vec<i64>,
    /// Configuration of all runs.
    #[serde(default)]
    pub set: Table,
    /// Tasks to learn.
    #[serde(rename = "task")]
    pub tasks: Vec<TaskEntry>,
    /// Methods to use; if empty, the defaults of `train`.
    #[serde(rename = "method", default)]
    pub methods: Vec<MethodEntry>,
    /// Configuration keys, each with its list of values.
    #[serde(default)]
    pub grid: Table,
    /// Search for values of keys, instead of the grid.
    pub search: Option<Search>,
}

/// A task of the sweep.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskEntry {
    /// Name, as in `train TASK`.
    pub name: String,
    /// `run.steps` [environment steps].
    pub steps: Option<i64>,
    /// Configuration of its runs; overrides that of all runs.
    #[serde(default)]
    pub set: Table,
}

/// A method of the sweep.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MethodEntry {
    /// Part of the runs' paths.
    pub name: String,
    /// Label in plots and tables; by default the name.
    pub label: Option<String>,
    /// As `train --algo`.
    pub algo: Option<String>,
    /// As `train --policy`.
    pub policy: Option<String>,
    /// As `train --preset`.
    pub preset: Option<String>,
    /// Configuration of its runs; overrides that of the task.
    #[serde(default)]
    pub set: Table,
}

impl SweepFile {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// Wrong use: a missing file, invalid TOML, an unknown key, no runs, or a grid without values.
    pub fn read(path: &Path) -> anyhow::Result<(Self, String)> {
        let refused = |what: String| wrong_use(format!("sweep file {}: {what}", path.display()));
        let metadata = std::fs::metadata(path).map_err(|error| refused(error.to_string()))?;
        if !metadata.is_file() || metadata.len() > FILE_BYTES_MAX {
            return Err(refused(format!("expected a file of at most {FILE_BYTES_MAX} bytes")));
        }
        let text = std::fs::read_to_string(path).map_err(|error| refused(error.to_string()))?;
        let file = Self::parse(&text).map_err(refused)?;
        Ok((file, text))
    }

    fn parse(text: &str) -> Result<Self, String> {
        let mut file: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        if file.seeds.is_empty() {
            return Err("seeds: expected at least one".to_owned());
        }
        if file.tasks.is_empty() {
            return Err("expected at least one [[task]]".to_owned());
        }
        if file.methods.is_empty() {
            file.methods.push(MethodEntry { name: "default".to_owned(), ..Default::default() });
        }
        if file.search.is_some() && !file.grid.is_empty() {
            return Err("[grid] and [search] exclude each other; expected one of them".to_owned());
        }
        for (key, values) in flatten(&file.grid) {
            if values.as_array().is_none_or(Vec::is_empty) {
                return Err(format!("grid.{key}: expected a list of values"));
            }
        }
        Ok(file)
    }
}

/// Returns the leaves of nested tables with their dotted keys: `[set.algorithm] batch_size = 64`
/// and `"algorithm.batch_size" = 64` are equivalent.
pub fn flatten(table: &Table) -> Vec<(String, Value)> {
    let mut leaves = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => leaves.extend(
                flatten(inner).into_iter().map(|(below, leaf)| (format!("{key}.{below}"), leaf)),
            ),
            leaf => leaves.push((key.clone(), leaf.clone())),
        }
    }
    leaves
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINIMAL: &str = "seeds = [1]\n[[task]]\nname = 'reacher'\n";

    #[test]
    fn the_minimal_file_runs_the_defaults() {
        let file = SweepFile::parse(MINIMAL).unwrap();
        assert_eq!(file.methods.len(), 1);
        assert_eq!(file.methods[0].name, "default");
    }

    #[test]
    fn nested_and_dotted_keys_are_equivalent() {
        let nested = "[set.algorithm]\nbatch_size = 64\n[set.dmp]\nalpha_y = 9.0\n";
        let dotted = "[set]\n'algorithm.batch_size' = 64\ndmp.alpha_y = 9.0\n";
        let leaves = [nested, dotted].map(|set| {
            let mut leaves = flatten(&SweepFile::parse(&format!("{MINIMAL}{set}")).unwrap().set);
            leaves.sort_by(|a, b| a.0.cmp(&b.0));
            leaves
        });
        assert_eq!(leaves[0], leaves[1]);
        assert_eq!(leaves[0][0], ("algorithm.batch_size".to_owned(), Value::Integer(64)));
    }

    #[test]
    fn errors_name_the_missing_or_misspelt_key() {
        let refused = |text: &str| SweepFile::parse(text).unwrap_err();
        assert!(refused("seeds = []\n[[task]]\nname = 'a'").contains("seeds"));
        assert!(refused("seeds = [1]\ntask = []").contains("[[task]]"));
        assert!(refused(&format!("{MINIMAL}step = 5")).contains("step"));
        assert!(refused(&format!("{MINIMAL}[grid]\nrun.steps = 5")).contains("grid.run.steps"));
        assert!(refused(&format!("{MINIMAL}[grid]\nrun.steps = []")).contains("grid.run.steps"));
        let search = "[search]\ntrials = 2\nspace = { dmp.alpha_y = [9.0] }\n";
        assert!(SweepFile::parse(&format!("{MINIMAL}{search}")).unwrap().search.is_some());
        let both = refused(&format!("{MINIMAL}[grid]\ndmp.alpha_y = [9.0]\n{search}"));
        assert!(both.contains("[grid] and [search]"), "{both}");
    }
}
