//! Reads values of `dmprl bench` arguments.

use std::path::{Path, PathBuf};

use dmprl_run::failure::wrong_use;

/// Shorter rounds would mostly measure the benchmark's own sleep; longer ones are probably typos.
const SECONDS: std::ops::RangeInclusive<f64> = 0.05..=3600.0;

/// Reads a duration of a round in seconds.
pub(super) fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| SECONDS.contains(seconds));
    seconds.ok_or_else(|| format!("expected {} to {} seconds", SECONDS.start(), SECONDS.end()))
}

/// Makes the path absolute without resolving links: a virtual environment's `python` is a link, and
/// its location identifies the environment.
pub(super) fn interpreter(path: &Path) -> anyhow::Result<PathBuf> {
    let refused = |what: &str| {
        wrong_use(format!(
            "--peer-python {}: {what}; expected a Python interpreter, such as \
             /opt/envpool/bin/python",
            path.display()
        ))
    };
    let absolute = std::path::absolute(path).map_err(|error| refused(&error.to_string()))?;
    if absolute.is_file() { Ok(absolute) } else { Err(refused("not a file")) }
}
