//! A video of episodes that an observer has drawn, made by `envs_py/dmprl/film.py`.

use std::path::Path;
use std::time::Duration;

use super::Launcher;
use super::conversation::{Conversation, Turn};
use crate::control::Report;
use crate::failure::Outcome;
use crate::run_directory::RunDirectory;

/// From one frame to the next, and for the end of the animation, which is written at once.
const FRAME: Duration = Duration::from_secs(120);

/// Makes what `plan`, a file, asks for; `progress` is called with the number of frames done, and of
/// how many.
///
/// # Errors
/// It died or took too long.
pub fn film(
    run: &RunDirectory,
    python: &Path,
    plan: &Path,
    progress: &dyn Fn(u64, u64),
) -> anyhow::Result<Outcome> {
    let launcher = Launcher::outside_training(python.to_owned(), run, None);
    let maker = Conversation { who: "the maker of the video", log: run.log_path("film") };
    let answer = maker.hold(launcher.film(plan)?, |report| {
        Ok(match report {
            Report::Filmed { done, of } => {
                progress(done, of);
                if done < of { Turn::Wait("done", FRAME) } else { Turn::Over(()) }
            }
            _ => Turn::GoOn,
        })
    })?;
    Ok(answer.map_or(Outcome::Interrupted, |()| Outcome::Done))
}
