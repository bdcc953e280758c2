//! Reads the versions of an environment's packages, for the manifest of a run.

use anyhow::{Context, Result, anyhow};
use dmprl_run::Packages;

use crate::answer::answer;

/// Prints the fields of [`Packages`] as JSON. Importing the packages would take seconds.
const QUESTION: &str = "\
import hashlib, json, platform
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

def installed(name):
    try:
        return version(name)
    except PackageNotFoundError:
        return None

def sources():
    spec = find_spec('dmprl')
    if spec is None or not spec.origin:
        return None
    folder = Path(spec.origin).parent
    digest = hashlib.sha256()
    for path in sorted(folder.rglob('*.py')):
        content = path.read_bytes()
        name = path.relative_to(folder).as_posix()
        digest.update(f'{name} {len(content)}\\n'.encode() + content)
    return digest.hexdigest()

print(json.dumps({
    'python': platform.python_version(),
    'mujoco': installed('mujoco'),
    'gymnasium': installed('gymnasium'),
    'numpy': installed('numpy'),
    'dmprl_sha256': sources(),
}))";

/// Reads the versions from the interpreter of an environment.
///
/// # Errors
/// The interpreter does not run, or does not answer in time.
pub fn packages(python: &std::path::Path) -> Result<Packages> {
    let cannot = || format!("cannot read the package versions of {}", python.display());
    let text = answer(python, &["-I", "-B", "-c", QUESTION])
        .map_err(|reason| anyhow!(reason))
        .with_context(cannot)?;
    serde_json::from_str(&text).with_context(cannot)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dmprl_actors::python_env::LINKED_PYTHON;

    #[test]
    fn versions_are_read_and_a_missing_interpreter_is_an_error() {
        let packages = packages(LINKED_PYTHON.executable.as_ref()).unwrap();
        assert_eq!(packages.python, LINKED_PYTHON.version_number());
        assert!(super::packages("/no/such/python".as_ref()).is_err());
    }
}
