//! Helpers of tests that need more than one crate.

pub mod exported;
pub mod hosts;
mod processes;
pub mod program;
mod run_files;
pub mod skip_list;
pub mod skipped;
mod waiting;

use std::path::{Path, PathBuf};

/// Returns the project's directory.
pub fn project_root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the parent of tests/")
}

/// Returns the folder with the tiny environments (`tiny_envs:Id`), for `--python-path`.
pub fn tiny_envs_dir() -> PathBuf {
    project_root().join("envs_py/tests")
}

/// Returns the project's `.venv`, made if it is missing, so that tests run what a user runs.
/// Concurrent test processes wait for each other.
///
/// # Panics
/// If it cannot be made; the message has the reason.
#[cfg(feature = "python")]
pub fn venv() -> &'static dmprl_supervisor::python_setup::PythonEnvironment {
    use std::sync::OnceLock;

    use dmprl_supervisor::python_setup::{PythonEnvironment, ensure};

    static VENV: OnceLock<PythonEnvironment> = OnceLock::new();
    VENV.get_or_init(|| {
        ensure(project_root(), &|line| eprintln!("{line}"))
            .unwrap_or_else(|error| panic!("the tests need a Python environment: {error:#}"))
    })
}
