//! Parses the table `[search]` of a sweep file.

use dmprl_shared::supervision::EvaluationRow;
use serde::{Deserialize, Serialize};
use toml::Table;

use super::space::{self, Parameter};

/// Maximum number of trials. A larger number is a mistake in the file.
const TRIALS_MAX: u32 = 10_000;
/// Default of `prune_after_trials`; the same as Optuna's.
const PRUNE_AFTER_TRIALS: u32 = 5;

/// Objective of a search: the mean over a trial's last evaluations, which is maximised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Objective {
    /// Mean return of the evaluation's episodes.
    #[default]
    Return,
    /// Fraction of successful episodes.
    Success,
}

impl Objective {
    /// Returns the value of an evaluation; `None` if the task does not report success.
    #[must_use]
    pub fn of(self, row: &EvaluationRow) -> Option<f64> {
        match self {
            Self::Return => Some(row.return_mean),
            Self::Success => row.success_rate,
        }
    }

    /// Returns the objective's name in the file.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Return => "return",
            Self::Success => "success",
        }
    }
}

/// Strategy that suggests the values of the next trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampler {
    /// Tree-structured Parzen estimator: values close to the best so far.
    #[default]
    Tpe,
    /// Random values within the space.
    Random,
}

/// Strategy that stops trials early.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pruner {
    /// Stops a trial that is worse than the median of the others at the same evaluation.
    #[default]
    Median,
    /// Stops the trials that lose a round of successive halving.
    Hyperband,
    /// Stops no trial.
    None,
}

/// A checked `[search]` table.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(try_from = "Entry")]
pub struct Search {
    /// Number of trials for each task and method.
    pub trials: u32,
    /// Objective to maximise.
    pub objective: Objective,
    /// Strategy for suggestions.
    pub sampler: Sampler,
    /// Strategy for pruning.
    pub pruner: Pruner,
    /// Number of finished trials before `median` prunes any.
    pub prune_after_trials: u32,
    /// Seed of the sampler.
    pub seed: u32,
    /// Search space.
    pub space: Vec<Parameter>,
    /// Points to try first, as `key = value`; missing keys are suggested by the sampler.
    pub first: Vec<Table>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    trials: u32,
    #[serde(default)]
    objective: Objective,
    #[serde(default)]
    sampler: Sampler,
    #[serde(default)]
    pruner: Pruner,
    #[serde(default = "prune_after_trials")]
    prune_after_trials: u32,
    #[serde(default)]
    seed: u32,
    space: Table,
    #[serde(default)]
    first: Vec<Table>,
}

fn prune_after_trials() -> u32 {
    PRUNE_AFTER_TRIALS
}

impl TryFrom<Entry> for Search {
    type Error = String;

    fn try_from(entry: Entry) -> Result<Self, String> {
        let trials = entry.trials;
        if !(1..=TRIALS_MAX).contains(&trials) {
            return Err(format!("search.trials = {trials}: expected 1 to {TRIALS_MAX}"));
        }
        let space = space::parse(&entry.space)?;
        let first: Result<Vec<_>, _> =
            entry.first.iter().map(|table| space::point(&space, table)).collect();
        let first = first?;
        if let Some(index) = first.iter().position(Table::is_empty) {
            return Err(format!("search.first, entry {}: no values", index + 1));
        }
        Ok(Self {
            trials,
            objective: entry.objective,
            sampler: entry.sampler,
            pruner: entry.pruner,
            prune_after_trials: entry.prune_after_trials,
            seed: entry.seed,
            space,
            first,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINIMAL: &str = "trials = 4\nspace = { dmp.alpha_y = [9.0, 25.0] }\n";

    #[test]
    fn the_minimal_table_has_defaults() {
        let search: Search = toml::from_str(MINIMAL).unwrap();
        assert_eq!(
            (search.objective, search.sampler, search.pruner, search.prune_after_trials),
            (Objective::Return, Sampler::Tpe, Pruner::Median, 5)
        );
    }

    #[test]
    fn errors_name_the_wrong_key_or_value() {
        for (text, words) in [
            (MINIMAL.replace("4", "0"), "search.trials = 0"),
            (MINIMAL.replace("trials", "trails"), "trails"),
            (format!("sampler = 'cma'\n{MINIMAL}"), "cma"),
            (format!("pruner = 'mean'\n{MINIMAL}"), "mean"),
            (format!("objective = 'loss'\n{MINIMAL}"), "loss"),
            (format!("{MINIMAL}[[first]]\ndmp.alpha_y = 1.0"), "search.first.dmp.alpha_y"),
            (format!("{MINIMAL}[[first]]\n"), "no values"),
        ] {
            let error = toml::from_str::<Search>(&text).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }
}
