//! Stage 3 of 8: environments in an embedded CPython; called by the rollout and the evaluator.
//!
//! The only folder that names pyo3. One process has one interpreter ([`Interpreter`]); a worker's
//! E environments are stepped by one Python call per segment ([`PythonEnvironments`]), which
//! fills arrays that both sides see. MuJoCo's own bindings release the GIL inside `mj_step`, so
//! physics does not block other threads that want Python; the rollout has none.

mod buffer;
mod environments;
mod error;
mod goals;
mod interpreter;
mod recording;

pub use environments::{PythonEnvironments, SUCCESS_NO, SUCCESS_NOT_REPORTED, SUCCESS_YES};
pub use error::PythonError;
pub use goals::{Goals, Relabelling};
pub use interpreter::{Interpreter, InterpreterOptions, loaded_python_version};
pub use recording::{JointKind, Joints, WrittenDown};

/// The CPython installation that this program was linked against, as its build found it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkedPython {
    /// Its interpreter, outside of any virtual environment: the one that makes `.venv`.
    pub executable: &'static str,
    /// `sys.version`, blanks normalised: number, build date and compiler.
    pub version: &'static str,
    /// `sys.base_prefix`: two installations of one version differ in it.
    pub base_prefix: &'static str,
    /// Where its libpython lies; the program's rpath.
    pub library_dir: &'static str,
}

/// What `build.rs` asked the interpreter that pyo3 chose.
pub const LINKED_PYTHON: LinkedPython = LinkedPython {
    executable: env!("DMPRL_PYTHON_EXECUTABLE"),
    version: env!("DMPRL_PYTHON_VERSION"),
    base_prefix: env!("DMPRL_PYTHON_BASE_PREFIX"),
    library_dir: env!("DMPRL_PYTHON_LIBRARY_DIR"),
};

impl LinkedPython {
    /// The version's number alone, for instance `3.11.7`.
    pub fn version_number(&self) -> &'static str {
        self.version.split(' ').next().unwrap_or(self.version)
    }
}
