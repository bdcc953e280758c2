//! Finds the CPython installation that this program uses.

use std::ffi::{CStr, OsStr, c_void};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use pyo3::ffi;

/// A CPython installation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkedPython {
    /// Its interpreter, outside of any virtual environment; creates `.venv`.
    pub executable: &'static str,
    /// `sys.version` with single spaces: number, build date and compiler.
    pub version: &'static str,
    /// `sys.base_prefix`, which distinguishes installations of one version.
    pub base_prefix: &'static str,
    /// Directory of its libpython; the program's rpath.
    pub library_dir: &'static str,
}

/// The installation that this program was linked against. If it does not exist, because the program
/// was built on another machine, this is the installation whose libpython the process has loaded.
pub static LINKED_PYTHON: LazyLock<LinkedPython> = LazyLock::new(|| {
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
});

impl LinkedPython {
    /// Version number, for instance `3.11.7`.
    pub fn version_number(&self) -> &'static str {
        self.version.split(' ').next().unwrap_or(self.version)
    }
}

/// Returns `sys.version` of the libpython that this process has loaded, with single spaces as in
/// [`LINKED_PYTHON`]. Works before CPython starts.
#[must_use]
pub fn loaded_python_version() -> String {
    // SAFETY: Py_GetVersion needs no interpreter and returns a static string.
    let version = unsafe { CStr::from_ptr(ffi::Py_GetVersion()) }.to_string_lossy();
    version.split_ascii_whitespace().collect::<Vec<_>>().join(" ")
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
