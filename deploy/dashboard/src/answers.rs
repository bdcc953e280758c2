//! Builds the dashboard's JSON answers from the catalogue, independent of HTTP.

use anyhow::Context;
use dmprl_analysis::plots::{colour, has_colour};
use serde::Serialize;
use serde_json::{Value, json};

use super::catalogue::Catalogue;
use super::table::rounded;
use super::watched::{Curves, Facts, Rows, State, Watched};
use super::{configuration, episode, videos};

/// Maximum number of curves in one request; a page has a dozen.
const CURVES_MAX: usize = 64;
/// Maximum number of evaluations in a table; the newest are kept.
const EVALUATIONS_MAX: usize = 50;

/// Reason for which a request is rejected.
#[derive(Debug)]
pub enum Refusal {
    /// The requested item does not exist.
    Missing(String),
    /// The request is invalid.
    Senseless(String),
    /// A file cannot be read.
    Failed(anyhow::Error),
}

impl From<anyhow::Error> for Refusal {
    fn from(error: anyhow::Error) -> Self {
        Self::Failed(error)
    }
}

/// A run in the list.
#[derive(Debug, Serialize)]
struct Listed<'r> {
    name: &'r str,
    #[serde(flatten)]
    facts: &'r Facts,
    /// Colour of the method, as `#rrggbb`.
    colour: String,
    state: State,
    env_steps: Option<f64>,
    wall_s: Option<f64>,
    env_steps_per_s: Option<f64>,
    return_mean: Option<f64>,
    best_return: Option<f64>,
    success_rate: Option<f64>,
    fault: Option<&'r str>,
}

/// Lists all runs with their state.
pub fn runs(catalogue: &mut Catalogue) -> Value {
    refresh(catalogue);
    let mut others: Vec<&str> = Vec::new();
    let listed: Vec<_> = catalogue
        .runs
        .iter()
        .map(|(name, watched)| {
            let method = watched.facts.method.as_str();
            if !others.contains(&method) {
                others.push(method);
            }
            let index = others.iter().position(|other| *other == method).unwrap_or(0);
            listed(name, watched, index)
        })
        .collect();
    json!({
        "root": catalogue.root().display().to_string(),
        "version": env!("CARGO_PKG_VERSION"),
        "left_out": catalogue.left_out,
        "runs": listed,
    })
}

/// Looks for new runs, and refreshes all runs.
pub fn refresh(catalogue: &mut Catalogue) {
    catalogue.walk();
    catalogue.runs.values_mut().for_each(Watched::refresh);
}

fn listed<'r>(name: &'r str, watched: &'r Watched, index: usize) -> Listed<'r> {
    let number = |key: &str| watched.last[key].as_f64().map(rounded);
    let newest = watched.evaluations.last();
    let best = watched.evaluations.iter().map(|row| row.return_mean).max_by(f64::total_cmp);
    let method = watched.facts.method.as_str();
    // A preset's runs have the colour of the method's other runs; dashes distinguish them.
    let plain = method.split_once(" (").map_or(method, |(plain, _)| plain);
    let colour = colour(index, if has_colour(method) { method } else { plain });
    Listed {
        name,
        facts: &watched.facts,
        colour: format!("#{:02x}{:02x}{:02x}", colour.0, colour.1, colour.2),
        state: watched.state,
        env_steps: number("env_steps").or(newest.map(|row| row.env_steps as f64)),
        wall_s: number("wall_s"),
        env_steps_per_s: number("env_steps_per_s"),
        return_mean: newest.map(|row| rounded(row.return_mean)),
        best_return: best.map(rounded),
        success_rate: newest.and_then(|row| row.success_rate).map(rounded),
        fault: watched.fault.as_deref(),
    }
}

/// Returns new points of the curves in `names`, separated by commas.
///
/// # Errors
/// The run or the file of rows does not exist, or too many curves are requested.
pub fn curves(
    catalogue: &mut Catalogue,
    (run, file): (&str, &str),
    names: &str,
    since: (u64, usize),
) -> Result<Curves, Refusal> {
    let rows = match file {
        "metrics" => Rows::Metrics,
        "evaluations" => Rows::Evaluations,
        other => {
            let expected = "expected metrics or evaluations";
            return Err(Refusal::Senseless(format!("file: {expected}, got {other:?}")));
        }
    };
    let names: Vec<&str> = names.split(',').filter(|name| !name.is_empty()).collect();
    if names.len() > CURVES_MAX {
        let count = names.len();
        return Err(Refusal::Senseless(format!(
            "curves: expected at most {CURVES_MAX} names, got {count}"
        )));
    }
    Ok(find(catalogue, run)?.curves(rows, &names, since)?)
}

/// Returns the newest evaluations of a run, newest first, with the return of each episode.
///
/// # Errors
/// The run does not exist.
pub fn evaluations(catalogue: &mut Catalogue, run: &str) -> Result<Value, Refusal> {
    let watched = find(catalogue, run)?;
    watched.refresh();
    let first_seed = watched.directory.config()?.evaluation.first_seed;
    let newest = watched.evaluations.iter().rev().take(EVALUATIONS_MAX);
    let rows: Vec<_> = newest
        .map(|row| {
            json!({
                "env_steps": row.env_steps,
                "wall_s": rounded(row.wall_s),
                "policy_version": row.policy_version,
                "return_mean": rounded(row.return_mean),
                "success_rate": row.success_rate.map(rounded),
                "smoothness": rounded(row.smoothness),
                "returns": row.returns.iter().copied().map(rounded).collect::<Vec<_>>(),
            })
        })
        .collect();
    Ok(json!({"first_seed": first_seed, "count": watched.evaluations.len(), "rows": rows}))
}

/// Returns the motion of the run's policy in one episode; null if it was never recorded.
///
/// # Errors
/// The run does not exist, or its file cannot be read.
pub fn motion(catalogue: &mut Catalogue, run: &str) -> Result<Value, Refusal> {
    Ok(episode::read(&find(catalogue, run)?.directory)?)
}

/// Lists the videos of a run.
///
/// # Errors
/// The run does not exist, or its folder cannot be read.
pub fn videos(catalogue: &mut Catalogue, run: &str) -> Result<Value, Refusal> {
    let found = videos::list(&find(catalogue, run)?.directory)?;
    Ok(json!({ "videos": found }))
}

/// Returns the path of a video.
///
/// # Errors
/// The run or the video does not exist.
pub fn video(
    catalogue: &mut Catalogue,
    run: &str,
    name: &str,
) -> Result<std::path::PathBuf, Refusal> {
    let directory = &find(catalogue, run)?.directory;
    let listed = videos::list(directory)?.into_iter().any(|video| video.name == name);
    if !listed {
        return Err(Refusal::Missing(format!("run {run} has no video {name:?}")));
    }
    Ok(videos::folder(directory).join(name))
}

/// Returns the processes of a run's last session; null if its supervisor wrote no file.
///
/// # Errors
/// The run does not exist, or its file is damaged.
pub fn processes(catalogue: &mut Catalogue, run: &str) -> Result<Value, Refusal> {
    let watched = find(catalogue, run)?;
    watched.refresh();
    let processes = watched.directory.processes()?;
    Ok(json!({"state": watched.state, "session": processes}))
}

/// Returns every configuration key of a run with its value.
///
/// # Errors
/// The run does not exist, or its file cannot be read.
pub fn config(catalogue: &mut Catalogue, run: &str) -> Result<Value, Refusal> {
    let config = find(catalogue, run)?.directory.config()?;
    let keys = configuration::flat(&config).context("cannot write the configuration")?;
    Ok(json!({ "keys": keys }))
}

fn find<'c>(catalogue: &'c mut Catalogue, run: &str) -> Result<&'c mut Watched, Refusal> {
    if !catalogue.runs.contains_key(run) {
        catalogue.walk();
    }
    let root = catalogue.root().display().to_string();
    let missing = || Refusal::Missing(format!("there is no run {run:?} in {root}"));
    catalogue.runs.get_mut(run).ok_or_else(missing)
}
