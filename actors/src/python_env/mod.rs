//! Stage 3 of 8: environments in an embedded CPython. Called by the rollout and the evaluator.
//!
//! Only this folder uses pyo3. A process has one interpreter ([`Interpreter`]). One Python call per
//! segment steps the E environments of a worker ([`PythonEnvironments`]) and fills arrays that Rust
//! reads.

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
