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

use dmprl_actors::python_env::LINKED_PYTHON;
use dmprl_supervisor::python_setup::{
    Home, Overview, PythonEnvironment, State, add_packages, ensure, ensure_extra, ensure_separate,
    overview, remove_packages,
};

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

/// Writes wheels of packages into the working directory, each from `NAME VERSION` and optionally a
/// requirement, and an index of them. A folder of wheels would do, but `PIP_FIND_LINKS` in the
/// environment would replace its setting.
const WHEELS: &str = "\
import pathlib, sys, zipfile

for line in sys.argv[1:]:
    name, version, *required = line.split(' ', 2)
    info = f'{name}-{version}.dist-info/'
    files = {
        f'{name}.py': f'version = {version!r}\\n',
        info + 'METADATA': f'Metadata-Version: 2.1\\nName: {name}\\nVersion: {version}\\n'
        + ''.join(f'Requires-Dist: {requirement}\\n' for requirement in required),
        info + 'WHEEL': 'Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n',
    }
    files[info + 'RECORD'] = ''.join(f'{path},,\\n' for path in [*files, info + 'RECORD'])
    path = pathlib.Path(f'{name}-{version}-py3-none-any.whl').resolve()
    with zipfile.ZipFile(path, 'w') as wheel:
        for member, text in files.items():
            wheel.writestr(member, text)
    folder = path.parent / 'simple' / name
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / 'index.html', 'a') as page:
        page.write(f'<a href={path.as_uri()}>{path.name}</a>\\n')
";

fn project() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    let package = root.path().join("envs_py");
    fs::create_dir_all(package.join("dmprl")).unwrap();
    fs::create_dir_all(package.join("locks")).unwrap();
    fs::write(package.join("locks/base.txt"), "# nothing\n").unwrap();
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
    assert!(lines[0].contains("pyproject.toml or locks/base.txt"), "{lines:#?}");
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

/// A project whose pip has an index of its own.
struct Offline {
    project: tempfile::TempDir,
    wheels: tempfile::TempDir,
}

impl Offline {
    fn new(packages: &[&str]) -> Self {
        let offline = Self { project: project(), wheels: tempfile::tempdir().unwrap() };
        let mut command = Command::new(LINKED_PYTHON.executable);
        command.args(["-I", "-c", WHEELS]).args(packages).current_dir(&offline.wheels);
        assert!(command.status().unwrap().success());
        ensured(offline.root()).0.unwrap();
        offline.configure_pip();
        offline
    }

    fn root(&self) -> &Path {
        self.project.path()
    }

    fn home(&self) -> Home {
        Home::Clone(self.root().to_owned())
    }

    /// Has to be repeated for a new `.venv`.
    fn configure_pip(&self) {
        let index = self.wheels.path().join("simple");
        let settings = format!("[global]\nindex-url = file://{}\n", index.display());
        fs::write(self.root().join(".venv/pip.conf"), settings).unwrap();
    }

    /// A requirement that needs no settings of pip.
    fn by_path(&self, wheel: &str) -> String {
        format!("{}/{wheel}-py3-none-any.whl", self.wheels.path().display())
    }

    fn add(&self, packages: &[&str]) -> anyhow::Result<()> {
        let packages: Vec<_> = packages.iter().map(|&package| package.to_owned()).collect();
        add_packages(&self.home(), &packages, false, &|_| ())
    }

    fn remove(&self, package: &str) -> anyhow::Result<()> {
        remove_packages(&self.home(), &[package.to_owned()], &|_| ())
    }

    fn overview(&self) -> Overview {
        overview(&self.home()).unwrap()
    }

    /// Version of an installed package.
    fn version(&self, package: &str) -> Option<String> {
        let script = format!("import {package}; print({package}.version)");
        let python = self.root().join(".venv/bin/python");
        let output = Command::new(python).args(["-I", "-c", &script]).output().unwrap();
        let version = String::from_utf8(output.stdout).unwrap().trim().to_owned();
        output.status.success().then_some(version)
    }

    fn pip_install(&self, package: &str) {
        let python = self.root().join(".venv/bin/python");
        let status = Command::new(python).args(["-m", "pip", "install", "-q", package]).status();
        assert!(status.unwrap().success());
    }
}

// A changed Python or a moved clone used to delete everything that a user had installed.
#[test]
fn moved_project_gets_its_added_packages_again_and_keeps_the_others_aside() {
    let mut offline = Offline::new(&["arm 1.0", "gripper 2.0"]);
    offline.add(&[&offline.by_path("arm-1.0")]).unwrap();
    offline.pip_install("gripper");
    assert_eq!(offline.overview().by_hand, ["dmprl env add gripper==2.0"]);

    let moved = tempfile::tempdir().unwrap();
    fs::rename(offline.root(), moved.path()).unwrap();
    offline.project = moved;
    let (recreated, lines) = ensured(offline.root());
    assert!(imports_dmprl(&recreated.unwrap()));
    assert!(lines[0].contains("recreating .venv: created for project"), "{lines:#?}");
    assert_eq!(offline.version("arm").as_deref(), Some("1.0"));
    assert_eq!(offline.version("gripper"), None);
    let found = offline.overview();
    let [old] = &found.old[..] else { panic!("{:?}", found.old) };
    assert_eq!(old.commands, ["dmprl env add gripper==2.0"]);
    assert!(old.folder.join("bin/python").exists());

    // The command that is shown.
    offline.configure_pip();
    offline.add(&["gripper==2.0"]).unwrap();
    assert_eq!(offline.version("gripper").as_deref(), Some("2.0"));
    assert_eq!(offline.overview().old[0].commands, [""; 0]);
    assert_eq!((offline.overview().state, ensured(offline.root()).1.len()), (State::Ready, 0));
}

#[test]
fn package_that_does_not_go_with_the_others_is_neither_installed_nor_remembered() {
    let offline = Offline::new(&[
        "common 1.0",
        "common 2.0",
        "newer 1.0 common>=2",
        "older 1.0 common<2",
        "own 1.0 common<3",
    ]);
    // As the requirements of the package itself do.
    let manifest = format!("{MANIFEST}dependencies = ['common<3']\n");
    fs::write(offline.root().join("envs_py/pyproject.toml"), manifest).unwrap();
    offline.add(&["newer"]).unwrap();
    assert_eq!(offline.version("common").as_deref(), Some("2.0"));

    let error = format!("{:#}", offline.add(&["older"]).unwrap_err());
    assert!(error.contains("dmprl env remove PACKAGE"), "{error}");
    let error = format!("{:#}", offline.add(&["common>=3"]).unwrap_err());
    assert!(error.contains("common"), "{error}");
    let error = format!("{:#}", offline.add(&["no-such-package"]).unwrap_err());
    assert!(error.contains("No matching distribution"), "{error}");
    let found = offline.overview();
    assert_eq!((found.added, found.state), (vec!["newer".to_owned()], State::Ready));
    assert_eq!(offline.version("common").as_deref(), Some("2.0"));
    assert_eq!(offline.version("older"), None);

    // The remedy of the message.
    offline.remove("newer").unwrap();
    assert_eq!(offline.version("newer"), None);
    offline.add(&["older", "own"]).unwrap();
    assert_eq!(offline.version("common").as_deref(), Some("1.0"));
    assert!(offline.remove("common").is_err(), "dmprl needs it");
    assert!(offline.remove("unknown").is_err());
}

#[test]
fn list_that_was_edited_is_installed_by_the_next_start() {
    let offline = Offline::new(&["arm 1.0", "gripper 2.0"]);
    fs::write(offline.root().join(".venv-packages.txt"), "# mine\narm\n").unwrap();
    assert!(matches!(offline.overview().state, State::Stale(_)));
    ensured(offline.root()).0.unwrap();
    assert_eq!(offline.version("arm").as_deref(), Some("1.0"));

    fs::write(offline.root().join(".venv-packages.txt"), "arm\nmissing\n").unwrap();
    let error = format!("{:#}", ensured(offline.root()).0.unwrap_err());
    assert!(error.contains("dmprl env remove"), "{error}");
    offline.remove("missing").unwrap();
    let (ready, lines) = ensured(offline.root());
    assert!(imports_dmprl(&ready.unwrap()));
    let is_recreated = lines.iter().any(|line| line.contains("creating"));
    assert!(!is_recreated, "a failed addition must not cost the environment: {lines:#?}");
}

#[test]
fn file_with_another_hash_than_the_locked_one_is_refused() {
    let offline = Offline::new(&["arm 1.0"]);
    let wheel = fs::read(offline.by_path("arm-1.0")).unwrap();
    let lock = offline.root().join("envs_py/locks/base.txt");
    let hash = sha256(&wheel);
    fs::write(&lock, format!("arm==1.0 \\\n    --hash=sha256:{hash}\n")).unwrap();
    ensured(offline.root()).0.unwrap();
    assert_eq!(offline.version("arm").as_deref(), Some("1.0"));

    let python = offline.root().join(".venv/bin/python");
    let mut uninstall = Command::new(python);
    uninstall.args(["-m", "pip", "uninstall", "--quiet", "--yes", "arm"]);
    assert!(uninstall.status().unwrap().success());
    fs::write(&lock, format!("arm==1.0 \\\n    --hash=sha256:{}\n", "0".repeat(64))).unwrap();
    let error = format!("{:#}", ensured(offline.root()).0.unwrap_err());
    assert!(error.contains("another hash") && error.contains("deploy/lock.sh"), "{error}");
    assert_eq!(offline.version("arm"), None);
}

fn sha256(bytes: &[u8]) -> String {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), bytes).unwrap();
    let output = Command::new("sha256sum").arg(file.path()).output().unwrap();
    String::from_utf8(output.stdout).unwrap().split(' ').next().unwrap().to_owned()
}

#[test]
fn a_separate_environment_is_made_once_for_its_requirements() {
    let folder = tempfile::tempdir().unwrap();
    let (venv, requirements) = (folder.path().join(".venv-other"), folder.path().join("list.txt"));
    let mark = venv.join("mark");
    let ensured = || ensure_separate(&venv, &requirements, &|_| ()).map(|it| it.executable);
    let error = format!("{:#}", ensured().unwrap_err());
    assert!(error.contains("list.txt, a file of a clone"), "{error}");
    fs::write(&requirements, "# nothing\n").unwrap();
    assert!(ensured().unwrap().starts_with(&venv));
    fs::write(&mark, "").unwrap();
    ensured().unwrap();
    assert!(mark.exists());
    // Another list, then an interpreter that has disappeared.
    fs::write(&requirements, "# still nothing\n").unwrap();
    ensured().unwrap();
    assert!(!mark.exists());
    fs::write(&mark, "").unwrap();
    fs::remove_file(venv.join("bin/python")).unwrap();
    ensured().unwrap();
    assert!(!mark.exists());
}
