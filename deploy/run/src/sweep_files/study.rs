//! A study: the trials of a search for one task and one method.

use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::supervision::EvaluationRow;
use serde_json::json;
use toml::{Table, Value};

use super::plan::{arguments, method_directory};
use super::search::Search;
use super::space::Parameter;
use super::trial::{Trial, TrialState};
use super::{PlannedRun, SweepFile};
use crate::failure::wrong_use;
use crate::replace_file;

/// `evaluation.first_seed` of a search. With the final evaluation's own seeds, from 1000 on, the
/// selected values would overfit to its episodes.
pub const TUNING_SEED: u64 = 5_000;
const FIRST_SEED: &str = "evaluation.first_seed";

/// A task with a method, and its trials.
#[derive(Debug, Clone)]
pub struct Study {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// Directory relative to the sweep's; also the study's name in Optuna's storage.
    pub directory: PathBuf,
    /// `run.seed` of each run of a trial.
    pub seeds: Vec<i64>,
    /// Configuration of a run without the searched keys. All trials have the same length.
    pub base: ExperimentConfig,
    /// Trials, by number.
    pub trials: Vec<Trial>,
    arguments: Vec<String>,
}

impl Study {
    /// Creates a study for every task with every method. Checks each extreme value of the space,
    /// with the other keys unchanged.
    ///
    /// - `configure`: returns the configuration for arguments of `dmprl train`.
    ///
    /// # Errors
    /// The errors of `train`, with the searched key; an evaluation on the final evaluation's seeds;
    /// two studies with the same directory.
    pub fn all(
        file: &SweepFile,
        search: &Search,
        configure: impl Fn(&[String]) -> anyhow::Result<ExperimentConfig>,
    ) -> anyhow::Result<Vec<Self>> {
        let mut studies: Vec<Self> = Vec::new();
        for task in &file.tasks {
            for method in &file.methods {
                let mut words = arguments(file, task, method, &[]);
                // First, so that the file can override it.
                words.splice(1..1, set(FIRST_SEED, &(TUNING_SEED as i64).into()));
                let method_name = method.label.clone().unwrap_or_else(|| method.name.clone());
                let title = format!("{} · {method_name}", task.name);
                let rejected = |what: &str, error: anyhow::Error| {
                    wrong_use(format!("{title}{what}: {error:#}"))
                };
                let base = configure(&words).map_err(|error| rejected("", error))?;
                let first_seed = base.evaluation.first_seed;
                if first_seed < TUNING_SEED {
                    return Err(wrong_use(format!(
                        "{title}: {FIRST_SEED} = {first_seed}: expected at least {TUNING_SEED}, \
                         so that the search is not tuned to the episodes of the final \
                         evaluation; remove the key"
                    )));
                }
                for (parameter, value) in values(search) {
                    let setting = set(&parameter.key, &value);
                    let words: Vec<_> = words.iter().cloned().chain(setting).collect();
                    let what = format!(", search.space.{} at {value}", parameter.key);
                    configure(&words).map_err(|error| rejected(&what, error))?;
                }
                let directory = method_directory(task, method);
                if studies.iter().any(|study| study.directory == directory) {
                    return Err(wrong_use(format!(
                        "two studies have the path {}: give each task and method a different name",
                        directory.display()
                    )));
                }
                studies.push(Self {
                    task: task.name.clone(),
                    method: method_name,
                    directory,
                    seeds: file.seeds.clone(),
                    base,
                    trials: Vec::new(),
                    arguments: words,
                });
            }
        }
        let mut seeds = file.seeds.clone();
        seeds.sort_unstable();
        if seeds.windows(2).any(|pair| pair[0] == pair[1]) {
            return Err(wrong_use("seeds: list each seed only once"));
        }
        Ok(studies)
    }

    /// Returns the study's name in Optuna's storage.
    #[must_use]
    pub fn name(&self) -> String {
        self.directory.display().to_string()
    }

    /// Formats the study's task and method.
    #[must_use]
    pub fn title(&self) -> String {
        format!("{} · {}", self.task, self.method)
    }

    /// Plans a trial's run with one seed.
    #[must_use]
    pub fn run(&self, trial: &Trial, seed: i64) -> PlannedRun {
        let settings = trial.values.iter().flat_map(|(key, value)| set(key, value));
        let mut arguments: Vec<_> = self.arguments.iter().cloned().chain(settings).collect();
        arguments.extend(["--seed".to_owned(), seed.to_string()]);
        let trial_name = [format!("trial {}", trial.number)];
        PlannedRun {
            task: self.task.clone(),
            method: self.method.clone(),
            point: trial_name.into_iter().chain(trial.point()).collect(),
            seed,
            directory: self.directory.join(trial.folder()).join(format!("seed-{seed}")),
            arguments,
        }
    }

    /// Returns the environment steps of a complete trial.
    #[must_use]
    pub fn trial_steps(&self) -> u64 {
        self.base.run.steps.saturating_mul(self.seeds.len() as u64)
    }

    /// Returns the number of evaluations of a run; the last one follows the last step.
    fn evaluations_max(&self) -> u64 {
        self.base.run.steps.div_ceil(self.base.evaluation.interval_steps.max(1)).max(1)
    }

    /// Returns the number of an evaluation within its trial. Workers cross the interval at slightly
    /// different steps, so the pruner compares evaluations by number.
    ///
    /// - `seed`: index of the run's seed in the list.
    pub fn evaluation_number(&self, seed: usize, row: &EvaluationRow) -> u64 {
        let count = self.evaluations_max();
        let within = row.env_steps / self.base.evaluation.interval_steps.max(1);
        let number =
            if row.env_steps >= self.base.run.steps { count } else { within.clamp(1, count) };
        seed as u64 * count + number
    }

    /// Returns the settings that all trials must share to be comparable.
    fn identity(&self, search: &Search) -> serde_json::Value {
        json!({
            "space": space_json(&search.space), "objective": search.objective,
            "seeds": self.seeds, "steps": self.base.run.steps,
        })
    }

    /// Returns the request that opens this study in `dmprl.search`.
    pub fn opening(&self, search: &Search) -> serde_json::Value {
        let first = |table: &Table| {
            let value = |(key, value)| (key, super::space::as_json(&value));
            table.clone().into_iter().map(value).collect::<serde_json::Map<_, _>>()
        };
        json!({
            "op": "open", "study": self.name(), "identity": self.identity(search),
            "space": space_json(&search.space), "sampler": search.sampler, "seed": search.seed,
            "pruner": search.pruner, "prune_after_trials": search.prune_after_trials,
            "steps_max": self.evaluations_max() * self.seeds.len() as u64,
            "first": search.first.iter().map(first).collect::<Vec<_>>(),
        })
    }

    /// Rejects a storage that was created with other settings.
    pub fn check_identity(&self, search: &Search, found: &serde_json::Value) -> anyhow::Result<()> {
        let expected = self.identity(search);
        for key in ["space", "objective", "seeds", "steps"] {
            anyhow::ensure!(
                expected[key] == found[key],
                "{}: its trials ran with {key} {}, but the file has {}; choose another --output",
                self.title(),
                found[key],
                expected[key]
            );
        }
        Ok(())
    }

    /// Reads the trials from the files in the study's directory.
    ///
    /// # Errors
    /// A file cannot be read, or belongs to another space.
    pub fn read_trials(&mut self, search: &Search, output: &Path) -> anyhow::Result<()> {
        self.trials = Trial::read_all(&search.space, &output.join(&self.directory))?;
        Ok(())
    }

    /// Returns the finished trial with the greatest objective; the first of equals.
    #[must_use]
    pub fn best(&self) -> Option<&Trial> {
        best_of(&self.trials)
    }

    /// Returns the path of the file that `Study::write_best` writes.
    #[must_use]
    pub fn best_path(&self, output: &Path) -> PathBuf {
        output.join(&self.directory).join("best.toml")
    }

    /// Writes the best trial's configuration for `dmprl train --config`. The file omits the seed
    /// and the evaluation's seeds, because the configuration should be trained and evaluated on
    /// other seeds.
    pub fn write_best(
        &self,
        output: &Path,
        configure: impl Fn(&[String]) -> anyhow::Result<ExperimentConfig>,
    ) -> anyhow::Result<()> {
        let Some(best) = self.best() else { return Ok(()) };
        let run = self.run(best, self.seeds[0]);
        let mut table = Table::try_from(configure(&run.arguments)?)
            .context("cannot write the configuration as TOML")?;
        for (table_name, key) in [("run", "seed"), ("evaluation", "first_seed")] {
            if let Some(Value::Table(inner)) = table.get_mut(table_name) {
                inner.remove(key);
            }
        }
        let head = format!(
            "# The best trial of a search, number {}, objective {}; use it with --config.\n# {}\n",
            best.number,
            best.objective.unwrap_or(f64::NAN),
            best.point().join(" ")
        );
        let text = toml::to_string(&table).context("cannot write the configuration as TOML")?;
        replace_file(&self.best_path(output), format!("{head}{text}").as_bytes())
    }
}

fn best_of(trials: &[Trial]) -> Option<&Trial> {
    let finished = trials.iter().filter(|trial| trial.state == TrialState::Finished);
    let objective = |trial: &Trial| trial.objective.unwrap_or(f64::NEG_INFINITY);
    finished.reduce(|best, trial| if objective(trial) > objective(best) { trial } else { best })
}

/// Result of a search for one task and method.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// Runs of the best trial, relative to the sweep's directory; empty before a trial has
    /// finished.
    pub runs: Vec<PathBuf>,
}

/// Reads the results of a search in `output` from its files, for reports.
///
/// # Errors
/// A trial's file cannot be read, or belongs to another space.
pub fn found(file: &SweepFile, search: &Search, output: &Path) -> anyhow::Result<Vec<Found>> {
    let mut all = Vec::new();
    for task in &file.tasks {
        for method in &file.methods {
            let directory = method_directory(task, method);
            let trials = Trial::read_all(&search.space, &output.join(&directory))?;
            let folder = best_of(&trials).map(|best| directory.join(best.folder()));
            let run = |folder: PathBuf| {
                file.seeds.iter().map(move |seed| folder.join(format!("seed-{seed}")))
            };
            all.push(Found {
                task: task.name.clone(),
                method: method.label.clone().unwrap_or_else(|| method.name.clone()),
                runs: folder.map(run).into_iter().flatten().collect(),
            });
        }
    }
    Ok(all)
}

fn space_json(space: &[Parameter]) -> Vec<serde_json::Value> {
    space.iter().map(Parameter::json).collect()
}

/// Returns all extreme values, one at a time.
fn values(search: &Search) -> impl Iterator<Item = (&Parameter, Value)> {
    let extremes = |parameter: &Parameter| parameter.domain.extremes();
    search
        .space
        .iter()
        .flat_map(move |parameter| extremes(parameter).into_iter().map(move |at| (parameter, at)))
}

fn set(key: &str, value: &Value) -> [String; 2] {
    ["--set".to_owned(), format!("{key}={value}")]
}

#[cfg(test)]
mod tests {
    use super::*;
    use dmprl_shared::config::Layers;

    const FILE: &str = "
        seeds = [1, 2]
        set = { evaluation.interval_steps = 1000 }
        [[task]]
        name = 'reacher'
        steps = 2500
        [[method]]
        name = 'mlp'
        label = 'TD3'
        policy = 'mlp'
        [search]
        trials = 4
        space = { dmp.alpha_y = { low = 1, high = 9 }, exploration.kind = ['gaussian', 'pink'] }
    ";

    /// Like `train`, for the arguments used in these tests.
    fn configure(words: &[String]) -> anyhow::Result<ExperimentConfig> {
        let mut layers = Layers::new();
        for pair in words.windows(2) {
            match pair[0].as_str() {
                "--set" => {
                    let (key, value) = pair[1].split_once('=').unwrap();
                    layers.set("--set", key, value)?;
                }
                "--steps" => layers.set("--steps", "run.steps", &pair[1])?,
                _ => {}
            }
        }
        Ok(layers.finish()?)
    }

    fn studies(text: &str) -> anyhow::Result<Vec<Study>> {
        let file: SweepFile = toml::from_str(text).unwrap();
        let search = file.search.clone().unwrap();
        Study::all(&file, &search, configure)
    }

    fn trial(number: u32, state: TrialState, objective: Option<f64>) -> Trial {
        let values = vec![("dmp.alpha_y".to_owned(), Value::Float(2.5))];
        Trial { number, values, state, objective }
    }

    fn row(env_steps: u64) -> EvaluationRow {
        EvaluationRow {
            env_steps,
            updates: 0,
            segments: 0,
            wall_s: 0.0,
            policy_version: 0,
            returns: vec![0.0],
            return_mean: 0.0,
            success_rate: None,
            smoothness: 0.0,
            at_bounds: None,
        }
    }

    #[test]
    fn a_trials_run_has_its_values_and_the_tuning_seeds() {
        let study = studies(FILE).unwrap().swap_remove(0);
        assert_eq!(study.base.evaluation.first_seed, TUNING_SEED);
        let run = study.run(&trial(7, TrialState::Running, None), 2);
        assert_eq!(
            run.arguments.join(" "),
            "reacher --set evaluation.first_seed=5000 --policy mlp \
             --set evaluation.interval_steps=1000 --steps 2500 --set dmp.alpha_y=2.5 --seed 2"
        );
        assert_eq!(run.directory.to_str(), Some("reacher/mlp/trial-007/seed-2"));
        assert_eq!(run.title(), "reacher · TD3 · trial 7 · dmp.alpha_y=2.5 · seed 2");
    }

    #[test]
    fn tuning_on_the_seeds_of_the_final_evaluation_is_rejected() {
        let error = studies(&FILE.replace("interval_steps", "first_seed")).unwrap_err();
        assert!(error.to_string().contains("evaluation.first_seed = 1000"), "{error}");
        assert!(studies(&FILE.replace("interval_steps = 1000", "first_seed = 6000")).is_ok());
    }

    #[test]
    fn a_value_that_train_rejects_is_reported_with_its_key() {
        let error = studies(&FILE.replace("'pink'", "'brown'")).unwrap_err().to_string();
        assert!(error.contains("search.space.exploration.kind at \"brown\""), "{error}");
        let error = studies(&FILE.replace("[1, 2]", "[2, 2]")).unwrap_err().to_string();
        assert!(error.contains("seeds"), "{error}");
    }

    #[test]
    fn evaluations_of_two_trials_at_about_the_same_step_have_the_same_number() {
        let study = studies(FILE).unwrap().swap_remove(0);
        let number = |seed, env_steps| study.evaluation_number(seed, &row(env_steps));
        assert_eq!([number(0, 1_000), number(0, 1_040), number(0, 2_016)], [1, 1, 2]);
        assert_eq!([number(0, 2_500), number(0, 2_530), number(1, 1_000)], [3, 3, 4]);
    }

    #[test]
    fn the_best_trial_has_the_greatest_objective_of_the_finished() {
        let mut study = studies(FILE).unwrap().swap_remove(0);
        assert_eq!(study.best(), None);
        study.trials = vec![
            trial(0, TrialState::Finished, Some(-9.0)),
            trial(1, TrialState::Finished, Some(-4.0)),
            trial(2, TrialState::Finished, Some(-4.0)),
            trial(3, TrialState::Pruned, None),
        ];
        assert_eq!(study.best().unwrap().number, 1);
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("reacher/mlp")).unwrap();
        study.write_best(folder.path(), configure).unwrap();
        let text = std::fs::read_to_string(study.best_path(folder.path())).unwrap();
        assert!(text.starts_with("# The best trial of a search, number 1, objective -4"), "{text}");
        let mut layers = Layers::new();
        layers.add("best.toml", text.parse().unwrap()).unwrap();
        let config = layers.finish().unwrap();
        assert_eq!((config.dmp.alpha_y, config.run.steps), (2.5, 2_500));
        assert_eq!(config.evaluation.first_seed, 1_000);
    }

    #[test]
    fn another_search_in_the_same_directory_is_rejected() {
        let file: SweepFile = toml::from_str(FILE).unwrap();
        let mut search = file.search.clone().unwrap();
        let study = Study::all(&file, &search, configure).unwrap().swap_remove(0);
        let found = study.identity(&search);
        search.trials = 100;
        study.check_identity(&search, &found).unwrap();
        search.space.pop();
        let error = study.check_identity(&search, &found).unwrap_err().to_string();
        assert!(error.contains("space") && error.contains("--output"), "{error}");
    }
}
