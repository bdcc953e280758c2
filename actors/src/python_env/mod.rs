//! Stage 3 of 8: environments in an embedded CPython. Called by the rollout and the evaluator.
//!
//! Only this folder and `deploy/extension` use pyo3. A process has one interpreter
//! ([`Interpreter`]): the program starts it, or, with the feature `extension`, is loaded by it. One
//! Python call per segment steps the E environments of a worker ([`PythonEnvironments`]) and fills
//! arrays that Rust reads.

mod buffer;
#[cfg(not(feature = "extension"))]
mod embedded;
mod environments;
mod error;
#[cfg(feature = "extension")]
mod extension;
mod goals;
mod host;
mod interpreter;
mod linked;
mod recording;

#[cfg(not(feature = "extension"))]
use embedded as cpython;
#[cfg(feature = "extension")]
use extension as cpython;

pub use cpython::host;
pub use environments::{PythonEnvironments, SUCCESS_NO, SUCCESS_NOT_REPORTED, SUCCESS_YES};
pub use error::PythonError;
#[cfg(feature = "extension")]
pub use extension::enter;
pub use goals::{Goals, Relabelling};
pub use host::HostPython;
pub use interpreter::{Interpreter, InterpreterOptions};
pub use linked::{LINKED_PYTHON, LinkedPython, loaded_python_version};
pub use recording::{JointKind, Joints, StepRecording};
