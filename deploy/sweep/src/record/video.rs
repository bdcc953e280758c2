//! Records videos of the episodes of one run, or of two side by side.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use dmprl_analysis::motion::{RecordedEpisode, RecordingReader, Robot};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::grouped;
use dmprl_run::{ChosenPolicy, Progress, RunDirectory, safe_name};
use dmprl_supervisor::{self as launch, ObservationPlan};
use serde::Serialize;

use super::film_plan::{FilmFiles, write};
use super::observer::Observer;

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
    /// Python interpreter that runs `dmprl.film`.
    pub python: PathBuf,
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
    progress.stage("making the video");
    let name = name(plan);
    let file = |ending: &str| temporary.path().join(format!("{name}{ending}"));
    let files = FilmFiles { mp4: file(".mp4"), gif: file(".gif"), strip: file(".png") };
    let film = write(&sides, &files, temporary.path())?;
    let run = plan.sides[0].0;
    let on_frame = |done, of| progress.at(done, of);
    if launch::film(run, &plan.python, &film, &on_frame)? == Outcome::Interrupted {
        return Ok(None);
    }
    let moved = |path: PathBuf| {
        let to = plan.output.join(path.file_name().unwrap_or_default());
        std::fs::rename(&path, &to).map(|()| to).with_context(cannot)
    };
    Ok(Some(Recordings {
        mp4: moved(files.mp4)?,
        gif: moved(files.gif)?,
        strip: moved(files.strip)?,
        sides,
    }))
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
        details: false,
    };
    if launch::observe(observation, &on_steps)? == Outcome::Interrupted {
        return Ok(None);
    }
    let mut recorded = RecordingReader::open(&output)?;
    let mut episodes = Vec::new();
    while let Some(episode) = recorded.next_episode()? {
        ensure!(!episode.frames.is_empty(), "the episode of seed {} has no frame", episode.seed);
        episodes.push(episode);
    }
    let (run, robot) = (run.path().to_owned(), recorded.robot);
    Ok(Some(SideRecord { run, policy_version: chosen.version, title, robot, episodes }))
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
