//! Creates a video of recorded episodes with `envs_py/dmprl/film.py`.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use dmprl_control::Report;
use dmprl_run::RunDirectory;
use dmprl_run::failure::Outcome;

use super::conversation::{Conversation, Turn};
use super::launcher::Launcher;

/// Maximum time between two frames, and for writing the animation after the last one.
const FRAME_LIMIT: Duration = Duration::from_secs(120);

/// Creates the video that the file `plan` describes. Calls `progress` with the number of completed
/// frames and the total number.
///
/// # Errors
/// The process died or took too long.
pub fn film(
    run: &RunDirectory,
    python: &Path,
    plan: &Path,
    progress: &dyn Fn(u64, u64),
) -> anyhow::Result<Outcome> {
    let launcher = Launcher::outside_training(python.to_owned(), run, None);
    let mut command = Command::new(python);
    command.args(["-I", "-m", "dmprl.film"]).arg(plan);
    let command = launcher.streams(command, "film")?;
    let maker = Conversation { who: "the video process", log: run.log_path("film") };
    let answer = maker.hold(command, |report| {
        Ok(match report {
            Report::Filmed { done, of } => {
                progress(done, of);
                if done < of { Turn::Wait(FRAME_LIMIT) } else { Turn::Done(()) }
            }
            _ => Turn::Continue,
        })
    })?;
    Ok(answer.map_or(Outcome::Interrupted, |()| Outcome::Done))
}
