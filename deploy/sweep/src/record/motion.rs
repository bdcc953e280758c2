//! Rolls a run's latest policy out and measures its motion.

use anyhow::{Context, ensure};
use dmprl_analysis::motion::{self, Motion, RecordedPolicy};
use dmprl_run::failure::Outcome;
use dmprl_run::{PolicyChoice, RunDirectory};
use dmprl_supervisor::{self as launch, ObservationPlan};

use super::observer::Observer;

/// Measures the run's latest policy over as many episodes as an evaluation has, and writes
/// `motion.json`. Reads the file instead if it is up to date. Returns `None` if the user
/// interrupts.
///
/// # Errors
/// The run has no evaluation yet, the observer dies, or a file cannot be read or written.
pub fn measure_motion(run: &RunDirectory, observer: &Observer) -> anyhow::Result<Option<Motion>> {
    if let Some(motion) = motion::read(run)? {
        return Ok(Some(motion));
    }
    let chosen = run.choose_policy(PolicyChoice::Latest)?;
    let settings = run.config()?.evaluation;
    let folder = tempfile::tempdir().context("cannot create a temporary folder")?;
    let output = folder.path().join("episodes.jsonl");
    let plan = ObservationPlan {
        program: observer.program.clone(),
        run,
        venv: Some(observer.venv.clone()),
        policy_version: chosen.version,
        first_seed: settings.first_seed,
        episodes: settings.episodes as u64,
        output: output.clone(),
        pictures: None,
        details: false,
    };
    if launch::observe(plan, &|_, _| ())? == Outcome::Interrupted {
        return Ok(None);
    }
    let policy = RecordedPolicy {
        version: chosen.version,
        env_steps: chosen.row.map_or(0, |row| row.env_steps),
        first_seed: settings.first_seed,
    };
    let motion = motion::measure(&output, policy)?;
    ensure!(
        motion.returns.len() == settings.episodes,
        "{} episodes were recorded, expected {}",
        motion.returns.len(),
        settings.episodes
    );
    let text = serde_json::to_string(&motion).context("cannot serialize motion.json")?;
    run.write_motion(&(text + "\n"))?;
    Ok(Some(motion))
}
