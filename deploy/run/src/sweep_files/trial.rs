//! A trial of a search, and its file `trial.json`, which can be read without Optuna.

use std::path::Path;

use anyhow::Context;
use serde::{Deserialize, Serialize};
use serde_json::{Map, json};
use toml::Value;

use super::space::{Parameter, as_json};
use crate::format::shown;
use crate::replace_file;

/// State of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrialState {
    /// It has not ended yet.
    Running,
    /// All its runs have finished.
    Finished,
    /// It was stopped early because of its evaluations.
    Pruned,
    /// One of its runs failed.
    Failed,
}

impl TrialState {
    /// Returns the state's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Finished => "finished",
            Self::Pruned => "pruned",
            Self::Failed => "failed",
        }
    }
}

/// Values of the searched keys, and their result.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// Optuna's number of the trial, from 0.
    pub number: u32,
    /// Value of each searched key.
    pub values: Vec<(String, Value)>,
    /// State of the trial.
    pub state: TrialState,
    /// Mean over the seeds, once it has finished.
    pub objective: Option<f64>,
}

/// A trial in the search's storage.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StoredTrial {
    /// Number of the trial.
    pub trial: u32,
    /// State of the trial.
    pub state: TrialState,
    /// Value of each searched key.
    pub values: Map<String, serde_json::Value>,
    /// Mean over the seeds, once it has finished.
    pub objective: Option<f64>,
    /// Numbers of the evaluations reported so far.
    pub reported: Vec<u64>,
}

#[derive(Serialize, Deserialize)]
struct File {
    trial: u32,
    state: TrialState,
    values: Map<String, serde_json::Value>,
    objective: Option<f64>,
}

impl Trial {
    /// Creates a running trial with the suggested values.
    pub fn new(
        space: &[Parameter],
        number: u32,
        values: &Map<String, serde_json::Value>,
    ) -> anyhow::Result<Self> {
        let value = |parameter: &Parameter| {
            let key = &parameter.key;
            let value = values.get(key).and_then(|value| parameter.domain.value(value));
            let value = value.with_context(|| format!("trial {number} has no value for {key}"))?;
            Ok((key.clone(), value))
        };
        let values = space.iter().map(value).collect::<anyhow::Result<_>>()?;
        Ok(Self { number, values, state: TrialState::Running, objective: None })
    }

    /// Converts a trial of the storage.
    pub fn stored(space: &[Parameter], stored: &StoredTrial) -> anyhow::Result<Self> {
        let StoredTrial { trial, state, objective, ref values, .. } = *stored;
        if state == TrialState::Failed && values.len() < space.len() {
            // Another tool failed the trial before it had all its values.
            return Ok(Self { number: trial, values: Vec::new(), state, objective });
        }
        Ok(Self { state, objective, ..Self::new(space, trial, values)? })
    }

    /// Returns the name of the trial's folder.
    #[must_use]
    pub fn folder(&self) -> String {
        format!("trial-{:03}", self.number)
    }

    /// Formats the values as `key=value`.
    #[must_use]
    pub fn point(&self) -> Vec<String> {
        self.values.iter().map(|(key, value)| format!("{key}={value}")).collect()
    }

    /// Returns the values as JSON, by key.
    #[must_use]
    pub fn json_values(&self) -> Map<String, serde_json::Value> {
        self.values.iter().map(|(key, value)| (key.clone(), as_json(value))).collect()
    }

    /// Formats the values as arguments of `dmprl train`, quoted for a shell.
    #[must_use]
    pub fn set_line(&self) -> String {
        let plain = |letter: char| letter.is_ascii_alphanumeric() || "._-+=/".contains(letter);
        let setting = |(key, value): &(String, Value)| {
            // `--set` reads a value that is not valid TOML as a string.
            let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            let pair = format!("{key}={text}");
            let quoted = format!("'{}'", pair.replace('\'', r"'\''"));
            format!("--set {}", if pair.chars().all(plain) { pair } else { quoted })
        };
        self.values.iter().map(setting).collect::<Vec<_>>().join(" ")
    }

    /// Writes `trial.json` into the trial's folder below the study's.
    pub fn write(&self, study: &Path) -> anyhow::Result<()> {
        let folder = study.join(self.folder());
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
        let text = json!({
            "trial": self.number, "state": self.state, "values": self.json_values(),
            "objective": self.objective,
        });
        replace_file(&folder.join("trial.json"), format!("{text:#}\n").as_bytes())
    }

    /// Reads every `trial.json` in a study's directory, sorted by number; empty if the directory
    /// does not exist.
    pub fn read_all(space: &[Parameter], study: &Path) -> anyhow::Result<Vec<Self>> {
        let Ok(entries) = std::fs::read_dir(study) else { return Ok(Vec::new()) };
        let mut trials = Vec::new();
        for entry in entries {
            let path = entry.with_context(|| format!("cannot read {}", study.display()))?.path();
            let Ok(text) = std::fs::read_to_string(path.join("trial.json")) else { continue };
            let read = || -> anyhow::Result<Self> {
                let File { trial, state, values, objective } = serde_json::from_str(&text)?;
                Self::stored(
                    space,
                    &StoredTrial { trial, state, values, objective, reported: Vec::new() },
                )
            };
            trials.push(read().with_context(|| format!("{}: trial.json", shown(&path)))?);
        }
        trials.sort_by_key(|trial| trial.number);
        Ok(trials)
    }
}

#[cfg(test)]
mod tests {
    use super::super::space::parse;
    use super::*;

    #[test]
    fn a_trial_is_read_back_and_its_set_line_is_quoted_for_a_shell() {
        let space = parse(
            &"dmp.alpha_y = { low = 1, high = 9 }\nexploration.kind = ['gaussian', 'pink']\n\
              policy.hidden = [[32, 32], [64]]"
                .parse()
                .unwrap(),
        )
        .unwrap();
        let values = json!({
            "dmp.alpha_y": 2.5, "exploration.kind": "pink", "policy.hidden": "[32, 32]",
        });
        let values = values.as_object().unwrap();
        let mut trial = Trial::new(&space, 12, values).unwrap();
        assert_eq!(
            trial.set_line(),
            "--set dmp.alpha_y=2.5 --set exploration.kind=pink --set 'policy.hidden=[32, 32]'"
        );
        assert_eq!(trial.point()[1], "exploration.kind=\"pink\"");
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Trial::read_all(&space, folder.path()).unwrap(), []);
        trial.write(folder.path()).unwrap();
        trial.state = TrialState::Finished;
        trial.objective = Some(-4.25);
        trial.write(folder.path()).unwrap();
        Trial { number: 3, state: TrialState::Pruned, objective: None, ..trial.clone() }
            .write(folder.path())
            .unwrap();
        let read = Trial::read_all(&space, folder.path()).unwrap();
        assert_eq!((read[0].number, &read[1]), (3, &trial));
        assert!(Trial::new(&space, 0, &Map::new()).is_err());
    }
}
