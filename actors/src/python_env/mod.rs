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
mod linked;
mod recording;

pub use environments::{PythonEnvironments, SUCCESS_NO, SUCCESS_NOT_REPORTED, SUCCESS_YES};
pub use error::PythonError;
pub use goals::{Goals, Relabelling};
pub use interpreter::{Interpreter, InterpreterOptions};
pub use linked::{LINKED_PYTHON, LinkedPython, loaded_python_version};
pub use recording::{JointKind, Joints, StepRecording};
