//! Records videos and logs of the episodes of one run, or of two side by side.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use dmprl_analysis::motion::{RecordedEpisode, RecordingReader, Robot};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::grouped;
use dmprl_run::{ChosenPolicy, Progress, RunDirectory, safe_name};
use dmprl_supervisor::{self as launch, FilmProgram, ObservationPlan};
use serde::Serialize;

use super::film_plan::{self, FilmFiles};
use super::observer::Observer;
use super::rerun_plan;

/// Plan of a recording.
pub struct RecordPlan<'a> {
    /// Runs to show side by side, and the policy of each.
    pub sides: Vec<(&'a RunDirectory, ChosenPolicy)>,
    /// Episode i is reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// Number of episodes.
    pub episodes: u64,
    /// Output directory.
    pub output: PathBuf,
    /// Program and environment of the observers.
    pub observer: Observer,
    /// Python interpreter that runs `dmprl.film` and `dmprl.rerun_log`.
    pub python: PathBuf,
    /// Whether to write a Rerun log too.
    pub rerun: bool,
}

/// Recording of one run.
#[derive(Debug, Serialize)]
pub struct SideRecord {
    /// Run directory.
    pub run: PathBuf,
    /// Version of the policy.
    pub policy_version: u64,
    /// Title above the picture.
    #[serde(skip)]
    pub title: String,
    /// Description of the robot.
    #[serde(skip)]
    pub robot: Robot,
    /// Recorded episodes.
    #[serde(skip)]
    pub episodes: Vec<RecordedEpisode>,
    /// The observer's file with the episodes and their details.
    #[serde(skip)]
    pub(super) observed: PathBuf,
}

/// Result of a recording.
#[derive(Debug, Serialize)]
pub struct Recordings {
    /// Recordings of each run.
    pub sides: Vec<SideRecord>,
    /// Path of the video.
    pub mp4: PathBuf,
    /// Path of the animation.
    pub gif: PathBuf,
    /// Path of the filmstrip.
    pub strip: PathBuf,
    /// Path of the Rerun log, if it was requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rrd: Option<PathBuf>,
}

/// Records the episodes; returns `None` if the user interrupts.
///
/// # Errors
/// Wrong use: the runs have different tasks. An environment cannot be rendered, for instance
/// without OpenGL. A file cannot be written.
pub fn record(
    plan: &RecordPlan<'_>,
    progress: &dyn Progress,
) -> anyhow::Result<Option<Recordings>> {
    let mut task = None;
    for (run, _) in &plan.sides {
        let id = run.config()?.task.id;
        let first = task.get_or_insert_with(|| id.clone());
        if *first != id {
            return Err(wrong_use(format!(
                "{} is a run of {id}, not of {first}; episodes of the same seed would differ",
                run.path().display()
            )));
        }
    }
    let cannot = || format!("cannot write to {}", plan.output.display());
    std::fs::create_dir_all(&plan.output).with_context(cannot)?;
    let temporary = tempfile::Builder::new()
        .prefix(".recording-")
        .tempdir_in(&plan.output)
        .with_context(cannot)?;
    let titles = titles(&plan.sides)?;
    let mut sides = Vec::new();
    for (index, title) in titles.into_iter().enumerate() {
        let folder = temporary.path().join(index.to_string());
        let Some(side) = observe(plan, SidePlan { index, title, folder }, progress)? else {
            return Ok(None);
        };
        sides.push(side);
    }
    let name = name(plan);
    let file = |ending: &str| temporary.path().join(format!("{name}{ending}"));
    let files = FilmFiles { mp4: file(".mp4"), gif: file(".gif"), strip: file(".png") };
    let film = film_plan::write(&sides, &files, temporary.path())?;
    progress.stage("making the video");
    if make(plan, FilmProgram::Video, &film, progress)? == Outcome::Interrupted {
        return Ok(None);
    }
    let moved = |path: PathBuf| {
        let to = plan.output.join(path.file_name().unwrap_or_default());
        std::fs::rename(&path, &to).map(|()| to).with_context(cannot)
    };
    // Before the log is written, so that a failure there costs only the log.
    let (mp4, gif, strip) = (moved(files.mp4)?, moved(files.gif)?, moved(files.strip)?);
    let rrd = plan.rerun.then(|| file(".rrd"));
    if let Some(rrd) = &rrd {
        let log = rerun_plan::write(&sides, rrd, temporary.path())?;
        progress.stage("writing the Rerun log");
        if make(plan, FilmProgram::RerunLog, &log, progress)? == Outcome::Interrupted {
            return Ok(None);
        }
    }
    Ok(Some(Recordings { mp4, gif, strip, rrd: rrd.map(moved).transpose()?, sides }))
}

/// Makes the files that `described` describes.
fn make(
    plan: &RecordPlan<'_>,
    program: FilmProgram,
    described: &Path,
    progress: &dyn Progress,
) -> anyhow::Result<Outcome> {
    let on_frame = |done, of| progress.at(done, of);
    launch::film(program, plan.sides[0].0, &plan.python, described, &on_frame)
}

/// Plan of the recording of one run.
struct SidePlan {
    /// Index of the run in the recording.
    index: usize,
    /// Title above the picture.
    title: String,
    /// Folder for the observer's files.
    folder: PathBuf,
}

/// Renders the episodes of one run.
fn observe(
    plan: &RecordPlan<'_>,
    side: SidePlan,
    progress: &dyn Progress,
) -> anyhow::Result<Option<SideRecord>> {
    let SidePlan { index, title, folder } = side;
    let (run, chosen) = &plan.sides[index];
    let pictures = folder.join("pictures");
    std::fs::create_dir_all(&pictures)
        .with_context(|| format!("cannot create {}", pictures.display()))?;
    let output = folder.join("episodes.jsonl");
    progress.stage(&format!("rendering {title}"));
    let episode_steps = run.spec()?.map_or(0, |spec| u64::from(spec.episode_steps));
    let on_steps = |episodes: u64, steps: u64| {
        let done = episodes * episode_steps + steps;
        progress.at(done, plan.episodes * episode_steps);
    };
    let observation = ObservationPlan {
        program: plan.observer.program.clone(),
        run,
        venv: Some(plan.observer.venv.clone()),
        policy_version: chosen.version,
        first_seed: plan.first_seed,
        episodes: plan.episodes,
        output: output.clone(),
        pictures: Some(pictures),
        details: plan.rerun,
    };
    if launch::observe(observation, &on_steps)? == Outcome::Interrupted {
        return Ok(None);
    }
    let mut recorded = RecordingReader::open(&output)?;
    let mut episodes = Vec::new();
    while let Some(episode) = recorded.next_episode()? {
        ensure!(!episode.frames.is_empty(), "the episode of seed {} has no frame", episode.seed);
        // The log is made from the observer's file.
        episodes.push(RecordedEpisode { details: None, ..episode });
    }
    let (run, robot) = (run.path().to_owned(), recorded.robot);
    let (policy_version, observed) = (chosen.version, output);
    Ok(Some(SideRecord { run, policy_version, title, robot, episodes, observed }))
}

/// Returns a title for each run: its method, or the run's name if the methods are equal.
fn titles(sides: &[(&RunDirectory, ChosenPolicy)]) -> anyhow::Result<Vec<String>> {
    let mut methods = Vec::new();
    for (run, _) in sides {
        let config = run.config()?;
        let algorithm = config.algorithm.name.name();
        let policy = format!("{:?}", config.policy.kind).to_lowercase();
        let task = if config.task.name.is_empty() { &config.task.id } else { &config.task.name };
        methods.push(format!("{task} · {algorithm} · {policy}"));
    }
    let same = methods.iter().skip(1).any(|method| *method == methods[0]);
    let titled = sides.iter().zip(methods).map(|((run, chosen), method)| {
        let name = run.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
        let steps = chosen
            .row
            .as_ref()
            .map_or_else(String::new, |row| format!(" · {} steps", grouped(row.env_steps)));
        format!("{}{steps}", if same { name } else { method })
    });
    Ok(titled.collect())
}

/// Returns a file name that describes the recording.
fn name(plan: &RecordPlan<'_>) -> String {
    let (_, chosen) = &plan.sides[0];
    let beside = plan.sides.iter().skip(1).map(|(run, chosen)| {
        let name = run.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
        format!("-beside-{}-policy-{}", safe_name(&name), chosen.version)
    });
    let beside: String = beside.collect();
    let seeds = match plan.episodes {
        1 => format!("seed-{}", plan.first_seed),
        count => format!("seeds-{}-{}", plan.first_seed, plan.first_seed + count - 1),
    };
    format!("policy-{}{beside}-{seeds}", chosen.version)
}
