//! Writes the input of `envs_py/dmprl/film.py`, as one JSON object.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::Serialize;

use super::video::SideRecord;

/// Frames per second if the environment does not report the duration of a step.
const DEFAULT_RATE: f64 = 25.0;

/// Paths of a recording's files.
#[derive(Debug, Clone, Serialize)]
pub(super) struct FilmFiles {
    pub(super) mp4: PathBuf,
    pub(super) gif: PathBuf,
    pub(super) strip: PathBuf,
}

#[derive(Debug, Serialize)]
struct FilmPlan<'a> {
    episodes: Vec<Vec<Side<'a>>>,
    control_dt_s: f64,
    rate: f64,
    #[serde(flatten)]
    files: &'a FilmFiles,
}

#[derive(Debug, Serialize)]
struct Side<'a> {
    title: String,
    success: &'static str,
    goal: &'a str,
    frames: &'a [PathBuf],
    steps: &'a [usize],
    rewards: &'a [f64],
    success_by_step: &'a [Option<bool>],
}

/// Writes the plan into `folder`; returns its path.
///
/// - `files`: paths of the files that `film.py` will write.
pub(super) fn write(
    sides: &[SideRecord],
    files: &FilmFiles,
    folder: &Path,
) -> anyhow::Result<PathBuf> {
    let first = &sides[0];
    let dt = first.robot.control_dt_s;
    for side in sides {
        ensure!(
            side.episodes.len() == first.episodes.len() && side.robot.control_dt_s == dt,
            "cannot show {} next to {}: they have {} and {} episodes, and steps of {dt} and {} s",
            first.run.display(),
            side.run.display(),
            first.episodes.len(),
            side.episodes.len(),
            side.robot.control_dt_s
        );
    }
    let episodes = (0..first.episodes.len()).map(|index| {
        let of = |side| side_of(side, index);
        sides.iter().map(of).collect()
    });
    let frame_steps = match first.episodes[0].frame_steps.as_slice() {
        [from, to, ..] => to - from,
        _ => 1,
    };
    let plan = FilmPlan {
        episodes: episodes.collect(),
        control_dt_s: dt,
        rate: if dt > 0.0 { 1.0 / (dt * frame_steps as f64) } else { DEFAULT_RATE },
        files,
    };
    let path = folder.join("plan.json");
    let text = serde_json::to_vec(&plan).context("cannot serialize the plan of the video")?;
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

fn side_of(side: &SideRecord, index: usize) -> Side<'_> {
    let episode = &side.episodes[index];
    let success = match episode.success {
        Some(true) => "at the goal",
        Some(false) => "not at the goal",
        None => "",
    };
    Side {
        title: format!("{} · episode {}", side.title, episode.seed),
        success,
        goal: &side.robot.goal_in_pictures,
        frames: &episode.frames,
        steps: &episode.frame_steps,
        rewards: &episode.rewards,
        success_by_step: &episode.success_by_step,
    }
}
