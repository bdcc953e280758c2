//! Makes files of recorded episodes with programs of `envs_py/dmprl`.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use dmprl_control::Report;
use dmprl_run::RunDirectory;
use dmprl_run::failure::Outcome;

use super::conversation::{Conversation, Turn};
use super::launcher::Launcher;

/// Maximum time between two frames, and for finishing the files after the last one.
const FRAME_LIMIT: Duration = Duration::from_secs(120);

/// A program that makes files of recorded episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FilmProgram {
    /// `film.py`: a video, an animation and a strip of frames.
    Video,
    /// `rerun_log.py`: a Rerun log.
    RerunLog,
}

impl FilmProgram {
    fn module(self) -> &'static str {
        match self {
            Self::Video => "dmprl.film",
            Self::RerunLog => "dmprl.rerun_log",
        }
    }

    fn who(self) -> &'static str {
        match self {
            Self::Video => "the video process",
            Self::RerunLog => "the process that writes the Rerun log",
        }
    }

    fn log(self) -> &'static str {
        match self {
            Self::Video => "film",
            Self::RerunLog => "rerun",
        }
    }
}

/// Makes the files that the file `plan` describes. Calls `progress` with the number of completed
/// frames and the total number.
///
/// # Errors
/// The process died or took too long.
pub fn film(
    program: FilmProgram,
    run: &RunDirectory,
    python: &Path,
    plan: &Path,
    progress: &dyn Fn(u64, u64),
) -> anyhow::Result<Outcome> {
    let launcher = Launcher::outside_training(python.to_owned(), run, None);
    let mut command = Command::new(python);
    command.args(["-I", "-m", program.module()]).arg(plan);
    let command = launcher.streams(command, program.log())?;
    let maker = Conversation { who: program.who(), log: run.log_path(program.log()) };
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
