//! The Python that has loaded this program as an extension module.

use std::ffi::CStr;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use pyo3::{prelude::*, types::PyDict};

use super::{HostPython, LinkedPython, PythonError, loaded_python_version};

/// Python code that finds the facts of this Python.
const FACTS: &CStr = c"\
import os, sys
from importlib.metadata import distribution
from importlib.util import find_spec
executable, prefix, base_prefix = sys.executable, sys.prefix, sys.base_prefix
base_executable = getattr(sys, '_base_executable', None) or executable
packages = os.path.dirname(os.path.dirname(find_spec('dmprl').origin))
found = distribution('dmprl')
metadata = next(found.locate_file(file) for file in found.files if file.name == 'METADATA')
";

static HOST: OnceLock<(HostPython, LinkedPython)> = OnceLock::new();

/// Reads the facts of the running Python. Called once, before anything else of this program.
///
/// - `program`: the command that runs this program.
///
/// # Errors
/// If Python cannot answer.
pub fn enter(py: Python<'_>, program: PathBuf) -> PyResult<()> {
    let globals = PyDict::new(py);
    py.run(FACTS, Some(&globals), None)?;
    let value = |name| globals.as_any().get_item(name);
    let path = |name| value(name)?.extract::<PathBuf>();
    let text = |name| value(name)?.extract::<String>().map(|text| &*text.leak());
    let host = HostPython {
        program,
        executable: path("executable")?,
        prefix: path("prefix")?,
        packages: path("packages")?,
        metadata: path("metadata")?,
    };
    let base_prefix = text("base_prefix")?;
    let installation = LinkedPython {
        executable: text("base_executable")?,
        version: loaded_python_version().leak(),
        base_prefix,
        library_dir: base_prefix,
    };
    // A second call finds the same facts.
    let _ = HOST.set((host, installation));
    Ok(())
}

/// Returns the Python that runs this program.
pub fn host() -> Option<&'static HostPython> {
    HOST.get().map(|(host, _)| host)
}

/// Returns the installation for `LINKED_PYTHON`.
pub(super) fn installation() -> LinkedPython {
    let entered = HOST.get().map(|(_, installation)| *installation);
    entered.unwrap_or(LinkedPython {
        executable: "",
        version: "",
        base_prefix: "",
        library_dir: "",
    })
}

/// Checks that the running Python is that of the virtual environment.
pub(super) fn start(venv: &Path) -> Result<(), PythonError> {
    let resolved = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    match host() {
        Some(host) if resolved(&host.prefix) == resolved(venv) => Ok(()),
        host => Err(PythonError::AlreadyStarted {
            running: host.map_or_else(String::new, |host| host.prefix.display().to_string()),
            asked: venv.display().to_string(),
        }),
    }
}
