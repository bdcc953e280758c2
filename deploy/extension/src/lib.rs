//! The `dmprl` program as an extension module of Python.
//!
//! A wheel must run in every Python, also where there is no shared libpython to embed. So the
//! command `dmprl` of a wheel is a Python script (`envs_py/dmprl_command`) that calls this
//! module, and every process of a run is started with that script.
#![cfg(feature = "module")]

use std::ffi::OsString;
use std::panic::{AssertUnwindSafe, catch_unwind};

use dmprl::cli;
use pyo3::prelude::*;

/// The module `dmprl_command._program`.
#[pymodule]
mod _program {
    use super::*;

    /// Runs a command and ends the process with its exit status.
    ///
    /// - `words`: the path of the script `dmprl`, and the arguments.
    #[pyfunction]
    fn run(py: Python<'_>, words: Vec<OsString>) -> PyResult<()> {
        let program = words.first().cloned().unwrap_or_default();
        dmprl_actors::python_env::enter(py, program.into())?;
        // SAFETY: The script has started no thread.
        let status = py.detach(|| catch_unwind(AssertUnwindSafe(|| unsafe { cli::main(words) })));
        // Python is not shut down, because threads may still use it.
        std::process::exit(status.map_or(cli::PANIC_STATUS, i32::from))
    }
}
