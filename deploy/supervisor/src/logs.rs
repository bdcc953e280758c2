//! Quotes a process's log in error messages.

use std::path::Path;

use dmprl_run::format::shown;
use dmprl_run::last_lines;

/// Returns the last lines of a log below a heading with its path, to be appended to an error.
pub(super) fn log_tail(path: &Path) -> String {
    format!("\n  last lines of {}:\n{}", shown(path), last_lines(path))
}
