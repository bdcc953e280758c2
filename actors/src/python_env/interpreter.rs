//! Starts and checks the only interpreter of this process, isolated in a virtual environment.

use std::{
    ffi::CStr,
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use pyo3::{prelude::*, types::PyDict};

use super::{LINKED_PYTHON, PythonError, cpython};

/// Python code that runs once after the start.
///
/// - `stdout` and `stdin` carry the supervisor's protocol, so `print` and `input` of an environment
///   must not use them.
/// - A BLAS thread pool in each worker would compete with the other workers. A user can override
///   this by setting the variables.
/// - Importing `signal`, as much of the standard library does, installs a handler for SIGINT even
///   if CPython is configured without signal handlers. Import it here and restore the default;
///   CPython keeps handlers that the role has installed.
const PREPARE: &CStr = c"\
import os, signal, sys
if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
sys.stdout = sys.stderr
sys.stdin = open(os.devnull)
for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')
base_prefix = os.path.realpath(sys.base_prefix)
expected = os.path.realpath(expected)
";

/// Options of the first start, which stay valid until the process exits.
static RUNNING: Mutex<Option<InterpreterOptions>> = Mutex::new(None);

/// Locations of the interpreter's packages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InterpreterOptions {
    /// The virtual environment; becomes `sys.prefix`.
    pub venv: PathBuf,
    /// The user's own directories (`--python-path`), appended to `sys.path` by
    /// `dmprl.python_path`.
    pub python_path: Vec<PathBuf>,
}

/// Proof that CPython is running in this process and was checked. The calling thread does not hold
/// the GIL. CPython is never shut down, because NumPy and MuJoCo cannot be loaded twice in one
/// process.
#[derive(Debug, Clone, Copy)]
pub struct Interpreter(());

impl Interpreter {
    /// Starts CPython in isolated mode: without `PYTHON*` variables, without a user site directory,
    /// without the working directory on `sys.path` and without signal handlers, which the roles
    /// install. The hash seed is fixed, so that the order of a set is the same in every run.
    ///
    /// A second call with the same options returns the running interpreter.
    ///
    /// # Errors
    /// `NoVenv`; `OtherVersion` or `OtherInstallation` if the loaded libpython or the virtual
    /// environment belongs to another installation; `Initialise`; `AlreadyStarted` with other
    /// options; `Path` if a Python path is not a directory; `Exception` if a module in one has the
    /// name of a standard module.
    pub fn start(options: &InterpreterOptions) -> Result<Self, PythonError> {
        let mut running = RUNNING.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(running) = &*running {
            return if running == options {
                Ok(Self(()))
            } else {
                Err(PythonError::AlreadyStarted {
                    running: format!("{running:?}"),
                    asked: format!("{options:?}"),
                })
            };
        }
        let python_path = absolute_paths(&options.python_path)?;
        cpython::start(&options.venv)?;
        // Python is running from here on, so a later start cannot succeed after an error below.
        *running = Some(options.clone());
        prepare(&options.venv, python_path)?;
        Ok(Self(()))
    }
}

/// Prepares `sys`, compares the installation's prefix with the linked one, and appends the user's
/// directories.
fn prepare(venv: &Path, python_path: Vec<String>) -> Result<(), PythonError> {
    Python::attach(|py| {
        let globals = PyDict::new(py);
        let run = || -> PyResult<(String, String)> {
            globals.set_item("expected", LINKED_PYTHON.base_prefix)?;
            py.run(PREPARE, Some(&globals), None)?;
            let value = |name| globals.as_any().get_item(name)?.extract();
            Ok((value("expected")?, value("base_prefix")?))
        };
        let (expected, got) = run().map_err(|error| PythonError::exception(py, &error))?;
        if expected != got {
            return Err(PythonError::OtherInstallation { venv: venv.to_owned(), expected, got });
        }
        let module = py.import("dmprl.python_path");
        let extended = module.and_then(|module| module.call_method1("extend", (python_path,)));
        extended.map(drop).map_err(|error| PythonError::exception(py, &error))
    })
}

impl Interpreter {
    /// Seeds the global generators of Python and NumPy, for environments that use them instead of
    /// Gymnasium's.
    ///
    /// # Errors
    /// `Exception` if NumPy cannot be imported.
    pub fn seed(&self, seed: u64) -> Result<(), PythonError> {
        Python::attach(|py| {
            // NumPy accepts 32 bits.
            let seed = seed >> 32;
            let module = |name: &str| py.import(name)?.call_method1("seed", (seed,));
            let seeded = module("random").and_then(|_| module("numpy.random"));
            seeded.map(drop).map_err(|error| PythonError::exception(py, &error))
        })
    }
}

/// Converts to absolute paths: `sys.path` must not depend on a later change of directory.
fn absolute_paths(paths: &[PathBuf]) -> Result<Vec<String>, PythonError> {
    let absolute = |path: &PathBuf| {
        let wrong = |reason| PythonError::Path { path: path.clone(), reason };
        let absolute = std::path::absolute(path).map_err(|_| wrong("it is empty"))?;
        if !absolute.is_dir() {
            return Err(wrong("it is not a directory"));
        }
        absolute.into_os_string().into_string().map_err(|_| wrong("it is not valid UTF-8"))
    };
    paths.iter().map(absolute).collect()
}
