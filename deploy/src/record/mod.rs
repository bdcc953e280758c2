//! Rolls saved policies out in observer processes: records videos of their episodes, and measures
//! their motion.
//!
//! For a video of one run, or of two side by side, an observer for each run renders the episodes.
//! Then `envs_py/dmprl/film.py` makes video, animation and filmstrip from the frames. All files are
//! created in a temporary folder next to the output, and moved when they are complete. `motion`
//! renders nothing and hands the episodes to [`crate::motion`].

mod film_plan;
mod motion;

use std::path::PathBuf;

use anyhow::{Context, ensure};
use serde::Serialize;

use crate::failure::{Outcome, wrong_use};
use crate::launch::{self, ObservationPlan};
use crate::motion::{Recorded, RecordedEpisode, Robot};
use crate::run_directory::{ChosenPolicy, RunDirectory};
use crate::terminal::StagesProgress;

use film_plan::write;
pub use motion::measure_motion;

/// How to start an observer process.
#[derive(Debug, Clone)]
pub struct Observer {
    /// The program that plays the observer: this one.
    pub program: PathBuf,
    /// The Python virtual environment.
    pub venv: PathBuf,
}

/// Plan of a recording.
pub struct RecordPlan<'a> {
    /// The runs, side by side, with the policy of each.
    pub sides: Vec<(&'a RunDirectory, ChosenPolicy)>,
    /// Episode i is reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// Number of episodes.
    pub episodes: u64,
    /// Output directory.
    pub output: PathBuf,
    /// The observers.
    pub observer: Observer,
    /// Python interpreter that makes the video.
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
    /// Path of the strip of frames.
    pub strip: PathBuf,
}

/// Records the episodes; returns `None` if the user interrupted it.
///
/// # Errors
/// Wrong use if the runs cannot be compared. An environment cannot be rendered, for instance
/// without OpenGL. The file system fails.
pub fn record(
    plan: &RecordPlan<'_>,
    progress: &StagesProgress,
) -> anyhow::Result<Option<Recordings>> {
    let mut task = None;
    for (run, _) in &plan.sides {
        let id = run.config()?.task.id;
        let first = task.get_or_insert_with(|| id.clone());
        if *first != id {
            return Err(wrong_use(format!(
                "{} is a run of {id}, not of {first}: an episode of the same seed would be another",
                run.path().display()
            )));
        }
    }
    let cannot = || format!("cannot write into {}", plan.output.display());
    std::fs::create_dir_all(&plan.output).with_context(cannot)?;
    let workshop = tempfile::Builder::new()
        .prefix(".recording-")
        .tempdir_in(&plan.output)
        .with_context(cannot)?;
    let titles = titles(&plan.sides)?;
    let mut sides = Vec::new();
    for (index, title) in titles.into_iter().enumerate() {
        let folder = workshop.path().join(index.to_string());
        let Some(side) = observe(plan, SidePlan { index, title, folder }, progress)? else {
            return Ok(None);
        };
        sides.push(side);
    }
    progress.stage("making the video");
    let name = name(plan);
    let file = |ending: &str| workshop.path().join(format!("{name}{ending}"));
    let made = [".mp4", ".gif", ".png"].map(file);
    let film = write(&sides, &made, workshop.path())?;
    let run = plan.sides[0].0;
    if launch::film(run, &plan.python, &film, &|done, of| progress.at(done, of))?
        == Outcome::Interrupted
    {
        return Ok(None);
    }
    let [mp4, gif, strip] = made.map(|path| {
        let to = plan.output.join(path.file_name().unwrap_or_default());
        std::fs::rename(&path, &to).map(|()| to)
    });
    let (mp4, gif, strip) =
        (|| Ok::<_, std::io::Error>((mp4?, gif?, strip?)))().with_context(cannot)?;
    Ok(Some(Recordings { sides, mp4, gif, strip }))
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
    progress: &StagesProgress,
) -> anyhow::Result<Option<SideRecord>> {
    let SidePlan { index, title, folder } = side;
    let (run, chosen) = &plan.sides[index];
    let pictures = folder.join("pictures");
    std::fs::create_dir_all(&pictures)
        .with_context(|| format!("cannot make {}", pictures.display()))?;
    let output = folder.join("episodes.jsonl");
    progress.stage(&format!("drawing {title}"));
    let episode_steps = run.spec()?.map_or(0, |spec| u64::from(spec.episode_steps));
    let told = |episodes: u64, steps: u64| {
        progress.at(episodes * episode_steps + steps, plan.episodes * episode_steps);
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
    };
    if launch::observe(observation, &told)? == Outcome::Interrupted {
        return Ok(None);
    }
    let mut recorded = Recorded::open(&output)?;
    let mut episodes = Vec::new();
    while let Some(episode) = recorded.next_episode()? {
        ensure!(!episode.frames.is_empty(), "the episode of seed {} has no frame", episode.seed);
        episodes.push(episode);
    }
    let (run, robot) = (run.path().to_owned(), recorded.robot);
    Ok(Some(SideRecord { run, policy_version: chosen.version, title, robot, episodes }))
}

/// Returns titles that distinguish the runs: the method, or the run's name if the methods are
/// equal.
fn titles(sides: &[(&RunDirectory, ChosenPolicy)]) -> anyhow::Result<Vec<String>> {
    let mut methods = Vec::new();
    for (run, _) in sides {
        let config = run.config()?;
        let algorithm = format!("{:?}", config.algorithm.name).to_lowercase();
        let policy = format!("{:?}", config.policy.kind).to_lowercase();
        let task = if config.task.name.is_empty() { &config.task.id } else { &config.task.name };
        methods.push(format!("{task} · {algorithm} · {policy}"));
    }
    let same = methods.iter().skip(1).any(|method| *method == methods[0]);
    let titled = sides.iter().zip(methods).map(|((run, chosen), method)| {
        let name = run.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
        let steps = chosen.row.as_ref().map_or_else(String::new, |row| {
            format!(" · {} steps", crate::terminal::grouped(row.env_steps))
        });
        format!("{}{steps}", if same { name } else { method })
    });
    Ok(titled.collect())
}

/// Returns a file name that describes the recording.
fn name(plan: &RecordPlan<'_>) -> String {
    let (_, chosen) = &plan.sides[0];
    let beside = plan.sides.iter().skip(1).map(|(run, chosen)| {
        let name = run.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
        format!("-beside-{}-policy-{}", crate::run_directory::safe_name(&name), chosen.version)
    });
    let beside: String = beside.collect();
    let seeds = match plan.episodes {
        1 => format!("seed-{}", plan.first_seed),
        count => format!("seeds-{}-{}", plan.first_seed, plan.first_seed + count - 1),
    };
    format!("policy-{}{beside}-{seeds}", chosen.version)
}
