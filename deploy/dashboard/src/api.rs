//! Builds the dashboard's JSON responses from the catalogue, independent of HTTP.

use anyhow::Context;
use dmprl_analysis::plots::{colour, has_colour};
use serde::Serialize;
use serde_json::{Value, json};

use super::cached_run::{CachedRun, Curves, Rows, RunInfo, State, TablePosition};
use super::catalogue::Catalogue;
use super::table::rounded;
use super::{configuration, episode, videos};

/// Maximum number of curves in one request; the page needs fewer than 20 per file.
const CURVES_MAX: usize = 64;
/// Maximum number of evaluations in a response; the newest are returned.
const EVALUATIONS_MAX: usize = 50;

/// Reason for a failed request.
#[derive(Debug)]
pub enum ApiError {
    /// The requested item does not exist.
    NotFound(String),
    /// The request is invalid.
    BadRequest(String),
    /// The files of the run cannot be read.
    Internal(anyhow::Error),
}

impl From<anyhow::Error> for ApiError {
    fn from(error: anyhow::Error) -> Self {
        Self::Internal(error)
    }
}

/// A run in the list.
#[derive(Debug, Serialize)]
struct RunEntry<'r> {
    name: &'r str,
    #[serde(flatten)]
    info: &'r RunInfo,
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
    let mut methods: Vec<&str> = Vec::new();
    let entries: Vec<_> = catalogue
        .runs
        .iter()
        .map(|(name, run)| {
            let method = run.info.method.as_str();
            if !methods.contains(&method) {
                methods.push(method);
            }
            let index = methods.iter().position(|other| *other == method).unwrap_or(0);
            entry(name, run, index)
        })
        .collect();
    json!({
        "root": catalogue.root().display().to_string(),
        "version": env!("CARGO_PKG_VERSION"),
        "left_out": catalogue.left_out,
        "runs": entries,
    })
}

/// Searches for new runs, and refreshes all runs.
pub fn refresh(catalogue: &mut Catalogue) {
    catalogue.scan();
    catalogue.runs.values_mut().for_each(CachedRun::refresh);
}

fn entry<'r>(name: &'r str, run: &'r CachedRun, index: usize) -> RunEntry<'r> {
    let number = |key: &str| run.last_metrics[key].as_f64().map(rounded);
    let newest = run.evaluations.last();
    let best = run.evaluations.iter().map(|row| row.return_mean).max_by(f64::total_cmp);
    let method = run.info.method.as_str();
    // Runs of a preset, such as "TD3-DMP (paper)", share the method's colour; the page
    // distinguishes them by dashes.
    let plain = method.split_once(" (").map_or(method, |(plain, _)| plain);
    let colour = colour(index, if has_colour(method) { method } else { plain });
    RunEntry {
        name,
        info: &run.info,
        colour: format!("#{:02x}{:02x}{:02x}", colour.0, colour.1, colour.2),
        state: run.state,
        env_steps: number("env_steps").or(newest.map(|row| row.env_steps as f64)),
        wall_s: number("wall_s"),
        env_steps_per_s: number("env_steps_per_s"),
        return_mean: newest.map(|row| rounded(row.return_mean)),
        best_return: best.map(rounded),
        success_rate: newest.and_then(|row| row.success_rate).map(rounded),
        fault: run.fault.as_deref(),
    }
}

/// Returns the points of curves from a position on.
///
/// - `file`: `metrics` or `evaluations`.
/// - `names`: keys of the curves, separated by commas.
///
/// # Errors
/// The run or the file does not exist, or too many curves are requested.
pub fn curves(
    catalogue: &mut Catalogue,
    run: &str,
    file: &str,
    names: &str,
    from: TablePosition,
) -> Result<Curves, ApiError> {
    let rows = match file {
        "metrics" => Rows::Metrics,
        "evaluations" => Rows::Evaluations,
        other => {
            let expected = "expected metrics or evaluations";
            return Err(ApiError::BadRequest(format!("file: {expected}, got {other:?}")));
        }
    };
    let names: Vec<&str> = names.split(',').filter(|name| !name.is_empty()).collect();
    if names.len() > CURVES_MAX {
        let count = names.len();
        return Err(ApiError::BadRequest(format!(
            "curves: expected at most {CURVES_MAX} names, got {count}"
        )));
    }
    Ok(find(catalogue, run)?.curves(rows, &names, from)?)
}

/// Returns the newest evaluations of a run, newest first, with the return of each episode.
///
/// # Errors
/// The run does not exist, or its configuration cannot be read.
pub fn evaluations(catalogue: &mut Catalogue, run: &str) -> Result<Value, ApiError> {
    let run = find(catalogue, run)?;
    run.refresh();
    let first_seed = run.directory.config()?.evaluation.first_seed;
    let newest = run.evaluations.iter().rev().take(EVALUATIONS_MAX);
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
    Ok(json!({"first_seed": first_seed, "count": run.evaluations.len(), "rows": rows}))
}

/// Returns the motion of the run's policy in one episode; null if it has not been recorded.
///
/// # Errors
/// The run does not exist, or its file cannot be read.
pub fn motion(catalogue: &mut Catalogue, run: &str) -> Result<Value, ApiError> {
    Ok(episode::read(&find(catalogue, run)?.directory)?)
}

/// Lists the videos of a run.
///
/// # Errors
/// The run does not exist, or its folder cannot be read.
pub fn videos(catalogue: &mut Catalogue, run: &str) -> Result<Value, ApiError> {
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
) -> Result<std::path::PathBuf, ApiError> {
    let directory = &find(catalogue, run)?.directory;
    let listed = videos::list(directory)?.into_iter().any(|video| video.name == name);
    if !listed {
        return Err(ApiError::NotFound(format!("run {run} has no video {name:?}")));
    }
    Ok(videos::folder(directory).join(name))
}

/// Returns the run's state and the processes of its last session; the latter are null if the
/// supervisor wrote no file.
///
/// # Errors
/// The run does not exist, or its file is invalid.
pub fn processes(catalogue: &mut Catalogue, run: &str) -> Result<Value, ApiError> {
    let run = find(catalogue, run)?;
    run.refresh();
    let processes = run.directory.processes()?;
    Ok(json!({"state": run.state, "session": processes}))
}

/// Returns every configuration key of a run with its value.
///
/// # Errors
/// The run does not exist, or its file cannot be read.
pub fn config(catalogue: &mut Catalogue, run: &str) -> Result<Value, ApiError> {
    let config = find(catalogue, run)?.directory.config()?;
    let keys = configuration::flattened(&config).context("cannot serialize the configuration")?;
    Ok(json!({ "keys": keys }))
}

fn find<'c>(catalogue: &'c mut Catalogue, run: &str) -> Result<&'c mut CachedRun, ApiError> {
    if !catalogue.runs.contains_key(run) {
        catalogue.scan();
    }
    let root = catalogue.root().display().to_string();
    let missing = || ApiError::NotFound(format!("there is no run {run:?} in {root}"));
    catalogue.runs.get_mut(run).ok_or_else(missing)
}
