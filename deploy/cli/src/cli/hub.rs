//! Common to `dmprl push` and `dmprl pull`: the repository's name, and the program
//! `dmprl.hub` in Python, which transfers files.

use std::ffi::OsString;
use std::fmt::{self, Display, Formatter};
use std::path::Path;
use std::process::Command;
use std::str::FromStr;

use anyhow::{Context, anyhow};
use dmprl_run::failure::wrong_use;
use serde::Deserialize;

use super::attended::attend;
use super::prepare_python_with;

/// Extra of the Python package for the hub.
const EXTRA: &str = "hub";
/// Exit status of `dmprl.hub` if the request must change.
const REFUSED: i32 = 2;
/// Number of digits of a commit's id in a message.
const SHORT_COMMIT_LEN: usize = 10;

/// Name of a repository, `OWNER/NAME`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Repository {
    owner: String,
    name: String,
}

impl Repository {
    /// Returns the name of a run directory for this repository.
    pub(super) fn run_name(&self) -> String {
        format!("{}-{}", self.owner, self.name)
    }
}

impl Display for Repository {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}/{}", self.owner, self.name)
    }
}

impl FromStr for Repository {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let is_part = |part: &str| {
            let safe = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
            part.starts_with(|letter: char| letter.is_ascii_alphanumeric())
                && part.chars().all(safe)
        };
        match text.split_once('/') {
            Some((owner, name)) if is_part(owner) && is_part(name) => {
                Ok(Self { owner: owner.to_owned(), name: name.to_owned() })
            }
            _ => Err("expected OWNER/NAME, of letters, digits, `.`, `_` and `-`".into()),
        }
    }
}

/// Result of a transfer.
#[derive(Debug, Deserialize)]
pub(super) struct Transfer {
    /// Address of the repository.
    pub(super) address: String,
    /// Id of the commit that was made or downloaded.
    pub(super) commit: String,
}

impl Transfer {
    /// Returns the first digits of the commit's id.
    pub(super) fn short_commit(&self) -> &str {
        self.commit.get(..SHORT_COMMIT_LEN).unwrap_or(&self.commit)
    }
}

/// Answer of `dmprl.hub`.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Answer {
    Done(Transfer),
    Failed { error: String },
}

/// Runs `dmprl.hub` with these arguments, and installs its packages first if necessary. Returns
/// `None` if the user interrupts.
///
/// - `answer`: a file for its answer.
pub(super) fn transfer(words: &[OsString], answer: &Path) -> anyhow::Result<Option<Transfer>> {
    let (_, python) = prepare_python_with(EXTRA)?;
    let mut command = Command::new(python);
    command.args(["-I", "-W", "ignore", "-m", "dmprl.hub"]).args(words);
    command.arg("--answer").arg(answer);
    let Some(status) = attend(command)? else { return Ok(None) };
    let crashed = || format!("dmprl.hub ended with {status}; its output is above");
    let text = std::fs::read_to_string(answer).map_err(|_| anyhow!(crashed()))?;
    match serde_json::from_str(&text).with_context(crashed)? {
        Answer::Done(transfer) => Ok(Some(transfer)),
        Answer::Failed { error } if status.code() == Some(REFUSED) => Err(wrong_use(error)),
        Answer::Failed { error } => Err(anyhow!(error)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_repository_has_an_owner_and_a_name() {
        let repository: Repository = "me/panda-push.v2".parse().unwrap();
        assert_eq!(repository.to_string(), "me/panda-push.v2");
        assert_eq!(repository.run_name(), "me-panda-push.v2");
        for text in ["me", "me/", "/push", "me/a/b", "me/..", "-me/a", "me/a b", ""] {
            assert!(text.parse::<Repository>().is_err(), "{text}");
        }
    }
}
