//! The embedded CPython: which one this program is linked against, and its start.

use std::{
    ffi::{CStr, CString, OsStr, c_void},
    mem::MaybeUninit,
    os::unix::ffi::OsStrExt,
    path::{Path, PathBuf},
};

use pyo3::ffi;

use super::{HostPython, LINKED_PYTHON, LinkedPython, PythonError, loaded_python_version};

/// Returns `None`: no Python runs this program.
pub fn host() -> Option<&'static HostPython> {
    None
}

/// Returns the installation for [`LINKED_PYTHON`].
pub(super) fn installation() -> LinkedPython {
    let at_build = LinkedPython {
        executable: env!("DMPRL_PYTHON_EXECUTABLE"),
        version: env!("DMPRL_PYTHON_VERSION"),
        base_prefix: env!("DMPRL_PYTHON_BASE_PREFIX"),
        library_dir: env!("DMPRL_PYTHON_LIBRARY_DIR"),
    };
    if Path::new(at_build.executable).exists() {
        return at_build;
    }
    let version = loaded_python_version();
    loaded_library().and_then(|library| installation_of(&library, version)).unwrap_or(at_build)
}

/// Returns the path of the libpython that this process has loaded.
fn loaded_library() -> Option<PathBuf> {
    let function = ffi::Py_GetVersion as *const c_void;
    // SAFETY: the struct consists of plain pointers, for which zeros are valid. dladdr does not
    // dereference the address, and the strings that it returns live as long as the library, which
    // is never unloaded.
    let path = unsafe {
        let mut info: libc::Dl_info = std::mem::zeroed();
        if libc::dladdr(function, &raw mut info) == 0 || info.dli_fname.is_null() {
            return None;
        }
        CStr::from_ptr(info.dli_fname)
    };
    Path::new(OsStr::from_bytes(path.to_bytes())).canonicalize().ok()
}

/// Finds the installation of a `libpython3.11.so.1.0`: the nearest folder above it with a
/// `bin/python3.11`.
fn installation_of(library: &Path, version: String) -> Option<LinkedPython> {
    let name = library.file_name()?.to_str()?.strip_prefix("lib")?.split(".so").next()?;
    let interpreter = |prefix: &Path| prefix.join("bin").join(name);
    let prefix = library.ancestors().skip(1).find(|prefix| interpreter(prefix).exists())?;
    let leak = |path: &Path| path.to_str().map(|path| &*path.to_owned().leak());
    Some(LinkedPython {
        executable: leak(&interpreter(prefix))?,
        version: version.leak(),
        base_prefix: leak(prefix)?,
        library_dir: leak(library.parent()?)?,
    })
}

/// Starts CPython, isolated in a virtual environment.
pub(super) fn start(venv: &Path) -> Result<(), PythonError> {
    let executable = venv.join("bin/python");
    if !executable.exists() {
        return Err(PythonError::NoVenv { executable });
    }
    check_version()?;
    initialise(&executable)
}

/// Compares the loaded libpython with the linked one. Works before CPython starts.
fn check_version() -> Result<(), PythonError> {
    let got = loaded_python_version();
    if got == LINKED_PYTHON.version {
        return Ok(());
    }
    Err(PythonError::OtherVersion { expected: LINKED_PYTHON.version.to_owned(), got })
}

/// Initialises CPython and releases the GIL.
fn initialise(executable: &Path) -> Result<(), PythonError> {
    let executable_bytes = c_path(executable)?;
    let mut preconfig = MaybeUninit::uninit();
    let mut config = MaybeUninit::uninit();
    // SAFETY: CPython is not initialised (RUNNING is locked and empty; nothing else in this program
    // starts it). Both structs are initialised by their Init function before any field is accessed,
    // and the config is cleared on every path. PyEval_SaveThread follows a successful start on the
    // same thread, which then holds the GIL.
    unsafe {
        ffi::PyPreConfig_InitIsolatedConfig(preconfig.as_mut_ptr());
        let mut preconfig = preconfig.assume_init();
        // The default in isolated mode is ASCII, in which a model file with "°" cannot be read.
        preconfig.utf8_mode = 1;
        check(ffi::Py_PreInitialize(&raw const preconfig))?;

        ffi::PyConfig_InitIsolatedConfig(config.as_mut_ptr());
        let config: *mut ffi::PyConfig = config.as_mut_ptr();
        (*config).install_signal_handlers = 0;
        (*config).use_hash_seed = 1;
        (*config).hash_seed = 0;
        let status = ffi::PyConfig_SetBytesString(
            config,
            &raw mut (*config).executable,
            executable_bytes.as_ptr(),
        );
        let result = check(status).and_then(|()| check(ffi::Py_InitializeFromConfig(config)));
        ffi::PyConfig_Clear(config);
        result?;
        ffi::PyEval_SaveThread();
    }
    Ok(())
}

fn check(status: ffi::PyStatus) -> Result<(), PythonError> {
    let text = |pointer: *const std::ffi::c_char| {
        if pointer.is_null() {
            return String::new();
        }
        // SAFETY: not null; CPython's status strings are static and NUL-terminated.
        unsafe { CStr::from_ptr(pointer) }.to_string_lossy().into_owned()
    };
    // SAFETY: a pure predicate on a value that CPython returned.
    if unsafe { ffi::PyStatus_Exception(status) } == 0 {
        return Ok(());
    }
    Err(PythonError::Initialise { function: text(status.func), message: text(status.err_msg) })
}

fn c_path(path: &Path) -> Result<CString, PythonError> {
    CString::new(path.as_os_str().as_bytes())
        .map_err(|_| PythonError::Path { path: path.to_owned(), reason: "it contains a NUL byte" })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_library_belongs_to_the_nearest_interpreter_above_it() {
        let directory = tempfile::tempdir().unwrap();
        let prefix = directory.path().join("usr");
        let libraries = prefix.join("lib/x86_64-linux-gnu");
        let library = libraries.join("libpython3.12.so.1.0");
        fs::create_dir_all(&libraries).unwrap();
        fs::create_dir(prefix.join("bin")).unwrap();
        fs::write(prefix.join("bin/python3.11"), "").unwrap();
        assert_eq!(installation_of(&library, "3.12.3 (main)".into()), None, "of another version");
        fs::write(prefix.join("bin/python3.12"), "").unwrap();
        let found = installation_of(&library, "3.12.3 (main)".into()).unwrap();
        assert_eq!(Path::new(found.executable), prefix.join("bin/python3.12"));
        assert_eq!(Path::new(found.base_prefix), prefix);
        assert_eq!(Path::new(found.library_dir), libraries);
        assert_eq!(found.version_number(), "3.12.3");
    }

    #[test]
    fn the_loaded_library_belongs_to_the_linked_installation() {
        let library = loaded_library().unwrap();
        let found = installation_of(&library, loaded_python_version()).unwrap();
        assert_eq!(found.base_prefix, LINKED_PYTHON.base_prefix);
        assert_eq!(found.version, LINKED_PYTHON.version);
    }
}
