//! Finds the project's files, and says which commit the program was built from.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Ancestors searched for the project when the build's own folder is gone.
const ANCESTORS_MAX: usize = 16;

/// The folder that holds `envs_py/`: the one this program was built from, the one it lies in, as
/// in a released archive, or one above the current directory.
///
/// # Errors
/// Neither is there any more.
pub fn root() -> anyhow::Result<PathBuf> {
    let built_from = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).map(Path::to_owned);
    let beside = std::env::current_exe().ok().and_then(|file| file.parent().map(Path::to_owned));
    let here = std::env::current_dir().unwrap_or_default();
    let above = here.ancestors().take(ANCESTORS_MAX).map(Path::to_owned);
    built_from.into_iter().chain(beside).chain(above).find(|path| is_root(path)).ok_or_else(|| {
        anyhow::anyhow!(
            "cannot find the project's Python package; run dmprl inside a clone of the project, or \
             install it into a virtual environment (pip install ., in a clone)"
        )
    })
}

fn is_root(path: &Path) -> bool {
    path.join("envs_py").is_dir()
}

static GIT_COMMIT: OnceLock<String> = OnceLock::new();

/// Records the commit that this program was built from; empty if it is unknown. Only the program
/// itself is compiled again after a commit, so it passes the commit on at its start.
pub fn set_git_commit(commit: &str) {
    // A second call passes the same commit.
    let _ = GIT_COMMIT.set(commit.to_owned());
}

/// The commit that this program was built from, with `-dirty` where its sources differed from it;
/// none if it was built outside a git repository, or in a program that does not record it.
#[must_use]
pub fn git_commit() -> Option<String> {
    GIT_COMMIT.get().filter(|commit| !commit.is_empty()).cloned()
}
