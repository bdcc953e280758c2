//! Makes a real `.venv` for a package that needs neither a network nor a build tool.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::{
    fs,
    path::Path,
    process::Command,
    sync::{Barrier, Mutex},
    thread,
};

use dmprl_supervisor::python_setup::{Home, PythonEnvironment, ensure, ensure_extra};

const MANIFEST: &str = "\
[build-system]
requires = []
build-backend = \"backend\"
backend-path = [\".\"]

[project]
name = \"dmprl\"
version = \"0.1.0\"
";

/// The smallest build backend that supports an editable install (PEP 660).
const BACKEND: &str = "\
import os, zipfile

def build_editable(wheel_directory, config_settings=None, metadata_directory=None):
    if os.path.exists('broken'):
        raise SystemExit('\\n'.join(f'line {n} of the reason' for n in range(100)))
    info = 'dmprl-0.1.0.dist-info/'
    files = {
        'dmprl.pth': os.getcwd() + '\\n',
        info + 'METADATA': 'Metadata-Version: 2.1\\nName: dmprl\\nVersion: 0.1.0\\n',
        info + 'WHEEL': 'Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n',
    }
    files[info + 'RECORD'] = ''.join(f'{name},,\\n' for name in [*files, info + 'RECORD'])
    name = 'dmprl-0.1.0-py3-none-any.whl'
    with zipfile.ZipFile(os.path.join(wheel_directory, name), 'w') as wheel:
        for path, text in files.items():
            wheel.writestr(path, text)
    return name

def build_wheel(*arguments):
    raise NotImplementedError
";

fn project() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    let package = root.path().join("envs_py");
    fs::create_dir_all(package.join("dmprl")).unwrap();
    fs::write(package.join("pyproject.toml"), MANIFEST).unwrap();
    fs::write(package.join("backend.py"), BACKEND).unwrap();
    fs::write(package.join("dmprl/__init__.py"), "").unwrap();
    root
}

/// Returns the result and every progress line.
fn ensured(root: &Path) -> (anyhow::Result<PythonEnvironment>, Vec<String>) {
    let lines = Mutex::new(Vec::new());
    let result = ensure(root, &|line| lines.lock().unwrap().push(line.to_owned()));
    (result, lines.into_inner().unwrap())
}

fn imports_dmprl(environment: &PythonEnvironment) -> bool {
    let status =
        Command::new(&environment.executable).args(["-I", "-c", "import dmprl"]).status().unwrap();
    status.success()
}

#[test]
fn two_starts_at_once_make_one_environment() {
    let project = project();
    let both = Barrier::new(2);
    let start = || {
        both.wait();
        ensured(project.path())
    };
    let ((first, first_lines), (second, second_lines)) = thread::scope(|scope| {
        let other = scope.spawn(start);
        (start(), other.join().unwrap())
    });
    let environment = first.unwrap();
    assert_eq!(environment, second.unwrap());
    assert!(imports_dmprl(&environment));
    let lines = [first_lines, second_lines].concat();
    let ready = lines.iter().filter(|line| line.ends_with("ready")).count();
    let waits = lines.iter().any(|line| line.contains("waiting for another start"));
    assert_eq!((ready, waits), (1, true), "{lines:#?}");

    let (again, lines) = ensured(project.path());
    assert_eq!((again.unwrap(), lines.len()), (environment, 0), "{lines:?}");
}

#[test]
fn failed_or_killed_installation_is_reported_and_then_made_anew() {
    let project = project();
    let broken = project.path().join("envs_py/broken");
    fs::write(&broken, "").unwrap();
    let (failed, _) = ensured(project.path());
    let error = format!("{:#}", failed.unwrap_err());
    assert!(error.contains("pip install") && error.contains("line 99 of the reason"), "{error}");
    assert!(!error.contains("line 40 of the reason"), "only the end is shown: {error}");

    // The state after a kill during the installation.
    fs::remove_dir_all(project.path().join(".venv/lib")).unwrap();
    fs::remove_file(broken).unwrap();
    let (made, lines) = ensured(project.path());
    assert!(imports_dmprl(&made.unwrap()));
    assert!(lines[0].ends_with("the last attempt did not finish"), "{lines:#?}");

    fs::write(project.path().join("envs_py/pyproject.toml"), format!("{MANIFEST}\n")).unwrap();
    let (installed, lines) = ensured(project.path());
    assert!(imports_dmprl(&installed.unwrap()));
    assert!(lines[0].contains("pyproject.toml has changed"), "{lines:#?}");
    assert!(!lines.iter().any(|line| line.contains("creating .venv")), "{lines:#?}");
}

#[test]
fn an_extra_is_installed_when_it_is_asked_for_and_once() {
    let project = project();
    let manifest = project.path().join("envs_py/pyproject.toml");
    // Its requirement is in a folder beside it, so no network is needed.
    let other = project.path().join("other");
    fs::create_dir(&other).unwrap();
    fs::write(other.join("pyproject.toml"), MANIFEST.replace("\"dmprl\"", "\"other\"")).unwrap();
    let backend = BACKEND.replace("dmprl-0.1.0", "other-0.1.0").replace("dmprl", "other");
    fs::write(other.join("backend.py"), format!("{backend}\nbuild_wheel = build_editable\n"))
        .unwrap();
    fs::write(other.join("other.py"), "").unwrap();
    let extras = format!(
        "{MANIFEST}\n[project.optional-dependencies]\nsearch = ['other @ file://{0}']\n\
         broken = ['nothing @ file://{0}/nothing']\n",
        other.display()
    );
    fs::write(&manifest, extras).unwrap();

    let lines = Mutex::new(Vec::new());
    let asked = |extra: &str| {
        lines.lock().unwrap().clear();
        let home = Home::Clone(project.path().to_owned());
        ensure_extra(&home, extra, &|line| lines.lock().unwrap().push(line.to_owned()))
    };
    let environment = asked("search").unwrap();
    let imports_other = || {
        let mut command = Command::new(&environment.executable);
        command.args(["-I", "-c", "import other, dmprl"]).status().unwrap().success()
    };
    assert!(imports_other());
    assert!(lines.lock().unwrap().iter().any(|line| line.contains("installing other @ file")));
    asked("search").unwrap();
    assert_eq!(*lines.lock().unwrap(), [""; 0], "it is there");

    let error = format!("{:#}", asked("broken").unwrap_err());
    assert!(error.contains("cannot install nothing @ file"), "{error}");
    let error = format!("{:#}", asked("none").unwrap_err());
    assert!(error.contains("no optional part `none`"), "{error}");
    assert!(imports_other(), "what failed has harmed nothing");
}
