//! The outcome of a command: its exit status and the text of its errors.

use std::fmt::{self, Display, Formatter};

/// How a command that did not fail ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The command completed.
    Done,
    /// It was interrupted by the user.
    Interrupted,
}

/// Error for an invalid request; the exit status is 2 instead of 1.
#[derive(Debug)]
pub struct WrongUse(pub String);

impl Display for WrongUse {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

impl std::error::Error for WrongUse {}

/// Creates a [`WrongUse`] error.
pub fn wrong_use(message: impl Into<String>) -> anyhow::Error {
    WrongUse(message.into()).into()
}

/// Returns the exit status for scripts: 0 done, 1 failed, 2 wrong use, 130 interrupted.
#[must_use]
pub fn exit_status(result: &anyhow::Result<Outcome>) -> u8 {
    match result {
        Ok(Outcome::Done) => 0,
        Ok(Outcome::Interrupted) => 130,
        Err(error) if error.downcast_ref::<WrongUse>().is_some() => 2,
        Err(_) => 1,
    }
}

/// Formats an error as `error: MESSAGE`, then each cause on its own line.
#[must_use]
pub fn render(error: &anyhow::Error) -> String {
    let mut text = format!("error: {error}");
    // Skip a cause that the error above already includes.
    let mut last = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !last.contains(&cause) {
            text.push_str("\n  because: ");
            text.push_str(&cause.replace('\n', "\n  "));
        }
        last = cause;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;

    #[test]
    fn the_chain_of_causes_is_shown_without_debug_dumps() {
        let error = Err::<(), _>(std::io::Error::other("disk full"))
            .context("cannot write a/b")
            .unwrap_err();
        assert_eq!(render(&error), "error: cannot write a/b\n  because: disk full");
    }

    #[test]
    fn wrong_use_is_recognised_below_a_context() {
        let error = Err::<Outcome, _>(wrong_use("no such task")).context("cannot train");
        assert_eq!(exit_status(&error), 2);
        assert_eq!(exit_status(&Err(anyhow::anyhow!("x"))), 1);
        assert_eq!(exit_status(&Ok(Outcome::Interrupted)), 130);
    }
}
