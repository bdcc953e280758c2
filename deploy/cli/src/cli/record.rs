//! `dmprl record`: records a policy's episodes as a video, an animation, a strip of frames, and a
//! Rerun log.

use std::path::PathBuf;

use clap::Args;
use dmprl_analysis::motion::RecordedEpisode;
use dmprl_run::PolicyChoice;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::shown;
use dmprl_sweep::record::{Observer, RecordPlan, Recordings, record};

use super::trust::TrustArgs;
use super::{emit, open_run, prepare_python_with, this_program};
use crate::terminal::{TerminalProgress, say};

const HELP: &str = "\
The episodes are those of `dmprl eval`: noise-free, each with its own seed. Writes an MP4, a GIF,
and a PNG with a row of frames. They show the time, the return so far and, if the task reports it,
success. Needs no display: it renders with OpenGL by EGL or OSMesa; if both are missing, the error
names the packages. The tasks of `dmprl tasks` draw their goal; other environments are recorded as
their render mode `rgb_array` draws them.

--rerun writes a log for the viewer of rerun.io too. It has each step's observation, command, reward
and picture, and each segment's goal, weights and planned positions. The first use installs
rerun-sdk, a download of 170 MB, with the viewer `rerun`.

EXAMPLES
  dmprl record runs/mine
  dmprl record runs/mine --policy latest --episodes 3
  dmprl record zoo:panda-push --rerun
  dmprl record runs/td3-dmp --compare runs/td3-mlp --seed 1004
  dmprl record runs/mine --output pictures --json";

/// Maximum number of episodes; more would make the video too long to watch.
const EPISODES_MAX: u64 = 100;

/// Arguments of `dmprl record`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct RecordArgs {
    /// The run directory, or zoo:TASK for a policy that comes with dmprl.
    run: PathBuf,
    /// best (by success rate, then by return), latest, or a policy version.
    #[arg(long, default_value_t = PolicyChoice::Best, value_name = "best|latest|VERSION")]
    policy: PolicyChoice,
    /// Seed of the first episode [default: evaluation.first_seed of the run].
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Number of episodes, each with the next seed.
    #[arg(long, value_name = "N", default_value_t = 1,
        value_parser = clap::value_parser!(u64).range(1..=EPISODES_MAX))]
    episodes: u64,
    /// Show the episodes of this run, or zoo:TASK, next to them, with the same task and seeds. It
    /// uses the same choice of --policy, or its best if --policy is a version.
    #[arg(long, value_name = "RUN2")]
    compare: Option<PathBuf>,
    /// Output directory [default: videos in the run].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Also write a Rerun log (.rrd) of observations, commands, segments and pictures.
    #[arg(long)]
    rerun: bool,
    #[command(flatten)]
    trust: TrustArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &RecordArgs) -> anyhow::Result<Outcome> {
    let run = open_run(&args.run)?;
    let other = args.compare.as_deref().map(open_run).transpose()?;
    let mut sides = vec![(&run, run.choose_policy(args.policy)?)];
    if let Some(other) = &other {
        // A version belongs to one run; the other shows its best policy.
        let choice = match args.policy {
            PolicyChoice::Version(_) => PolicyChoice::Best,
            choice => choice,
        };
        sides.push((other, other.choose_policy(choice)?));
    }
    sides.iter().try_for_each(|(run, _)| args.trust.check(run))?;
    let first_seed = match args.seed {
        Some(seed) => seed,
        None => run.config()?.evaluation.first_seed,
    };
    if first_seed.checked_add(args.episodes).is_none() {
        return Err(wrong_use(format!("--seed {first_seed} leaves no seeds for its episodes")));
    }
    let (venv, python) = prepare_python_with("video")?;
    if args.rerun {
        prepare_python_with("rerun")?;
    }
    let plan = RecordPlan {
        sides,
        first_seed,
        episodes: args.episodes,
        output: args.output.clone().unwrap_or_else(|| run.path().join("videos")),
        observer: Observer { program: this_program()?, venv },
        python,
        rerun: args.rerun,
    };
    let progress = TerminalProgress::default();
    let made = record(&plan, &progress);
    drop(progress);
    let Some(recordings) = made? else { return Ok(Outcome::Interrupted) };
    if args.json {
        emit(&json(&recordings))?;
    } else {
        emit(&text(&recordings))?;
        if recordings.sides[0].robot.goal_in_pictures.is_empty() {
            say("the pictures may not show a goal: the environment does not declare it");
        }
    }
    Ok(Outcome::Done)
}

fn json(recordings: &Recordings) -> String {
    let mut object = serde_json::json!(recordings);
    for (side, made) in recordings.sides.iter().enumerate() {
        let episode = |episode: &RecordedEpisode| {
            serde_json::json!({
                "seed": episode.seed,
                "return": episode.return_,
                "success": episode.success,
                "steps": episode.rewards.len(),
                "frames": episode.frames.len(),
            })
        };
        object["sides"][side]["episodes"] = made.episodes.iter().map(episode).collect();
    }
    object.to_string()
}

fn text(recordings: &Recordings) -> String {
    let mut lines = Vec::new();
    for side in &recordings.sides {
        for episode in &side.episodes {
            let success = match episode.success {
                Some(true) => ", at the goal",
                Some(false) => ", not at the goal",
                None => "",
            };
            lines.push(format!(
                "episode     {}: return {:.2}{success} ({})",
                episode.seed, episode.return_, side.title
            ));
        }
    }
    for (what, path) in
        [("video", &recordings.mp4), ("animation", &recordings.gif), ("frames", &recordings.strip)]
    {
        lines.push(format!("{what:<12}{}", shown(path)));
    }
    if let Some(path) = &recordings.rrd {
        lines.push(format!("{:<12}{}", "rerun log", shown(path)));
    }
    lines.join("\n")
}
