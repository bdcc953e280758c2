//! Finds the project's files and records the commit that the program was built from.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Maximum number of ancestors of the current directory in which to look for the project.
const ANCESTORS_MAX: usize = 16;

/// Finds the folder that contains `envs_py/`: the folder that this program was built from, or the
/// current directory or one above it.
///
/// # Errors
/// None of these folders contains `envs_py/`.
pub fn root() -> anyhow::Result<PathBuf> {
    let built_from = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).map(Path::to_owned);
    let here = std::env::current_dir().unwrap_or_default();
    let above = here.ancestors().take(ANCESTORS_MAX).map(Path::to_owned);
    built_from.into_iter().chain(above).find(|path| is_root(path)).ok_or_else(|| {
        anyhow::anyhow!(
            "cannot find the project's Python package; run dmprl inside a clone of the project, or \
             install the package into a virtual environment (in a clone: pip install .)"
        )
    })
}

fn is_root(path: &Path) -> bool {
    path.join("envs_py").is_dir()
}

static GIT_COMMIT: OnceLock<String> = OnceLock::new();

/// Records the commit that this program was built from; empty if it is unknown. Only the binary is
/// recompiled after each commit, so it passes the commit to this library when it starts.
pub fn set_git_commit(commit: &str) {
    // A second call passes the same commit.
    let _ = GIT_COMMIT.set(commit.to_owned());
}

/// Returns the commit that this program was built from, with `-dirty` if its sources differed from
/// it; `None` if it was built outside a git repository or did not record the commit.
#[must_use]
pub fn git_commit() -> Option<String> {
    GIT_COMMIT.get().filter(|commit| !commit.is_empty()).cloned()
}
