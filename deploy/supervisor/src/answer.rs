//! Runs another program and returns its output, within a time limit.

use std::ffi::OsStr;
use std::process::Stdio;
use std::time::Duration;

use tokio::process::Command;

/// Maximum duration. Importing MuJoCo from a cold disk takes seconds.
const ANSWER_MAX: Duration = Duration::from_secs(60);

/// Runs `program` and returns its standard output.
///
/// # Errors
/// The program cannot be run, fails (the error is its last line), or takes too long.
pub fn answer(program: impl AsRef<OsStr>, arguments: &[&str]) -> Result<String, String> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| error.to_string())?;
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).kill_on_drop(true);
    let output = runtime
        .block_on(async { tokio::time::timeout(ANSWER_MAX, command.output()).await })
        .map_err(|_| format!("no answer within {} s", ANSWER_MAX.as_secs()))?
        .map_err(|error| error.to_string())?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let last = said.lines().rev().find(|line| !line.trim().is_empty());
    Err(last.map_or_else(|| output.status.to_string(), |line| line.trim().to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_has_the_last_line_of_standard_error() {
        assert_eq!(answer("sh", &["-c", "echo a; echo b"]).unwrap(), "a\nb");
        let failed = answer("sh", &["-c", "echo one >&2; echo two >&2; exit 3"]).unwrap_err();
        assert_eq!(failed, "two");
        assert!(answer("sh", &["-c", "exit 3"]).unwrap_err().contains('3'));
        assert!(answer("/no/such/program", &[]).is_err());
    }
}
