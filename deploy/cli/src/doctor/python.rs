//! Checks of the interpreter that this program was built for, and of `.venv`.

use std::path::Path;

use dmprl_actors::python_env::{LINKED_PYTHON, host, loaded_python_version};
use dmprl_supervisor::answer;
use dmprl_supervisor::python_setup::{Home, PythonEnvironment, State};
use serde::Deserialize;

use super::Check;

/// Script that prints the interpreter's facts. `find_spec` imports nothing.
const QUESTIONS: &str = "\
import json, os, sys, sysconfig
from importlib.util import find_spec
print(json.dumps({
    'version': ' '.join(sys.version.split()),
    'base_prefix': sys.base_prefix,
    'headers': os.path.join(sysconfig.get_path('include'), 'Python.h'),
    'has_headers': os.path.exists(os.path.join(sysconfig.get_path('include'), 'Python.h')),
    'has_venv': all(find_spec(name) is not None for name in ('venv', 'ensurepip')),
}))";
/// Script that prints the versions of packages in `.venv`. It imports them, because only an import
/// shows that a package works on this machine.
const PACKAGES: &str = "\
import gymnasium, mujoco, numpy, dmprl
print('gymnasium', gymnasium.__version__ + ',',
      'mujoco', mujoco.__version__ + ',', 'numpy', numpy.__version__)";
/// Flags for a script on the command line: isolated, and without writing bytecode.
const QUIETLY: [&str; 3] = ["-I", "-B", "-c"];

/// Output of the script [`QUESTIONS`].
#[derive(Debug, Deserialize)]
struct Facts {
    version: String,
    base_prefix: String,
    headers: String,
    has_headers: bool,
    has_venv: bool,
}

pub(super) fn checks() -> Vec<Check> {
    let mut checks = Vec::new();
    let home = Home::find();
    let state = home.as_ref().map_or(State::Missing, Home::state);
    match facts() {
        // Nothing is linked or built.
        Ok(facts) if host().is_some() => checks.push(interpreter(&facts)),
        Ok(facts) => checks.extend([
            interpreter(&facts),
            library(&loaded_python_version()),
            headers(&facts),
            venv_module(&facts, state == State::Ready),
        ]),
        Err(error) => {
            let found = format!("{}: {error}", LINKED_PYTHON.executable);
            checks.push(Check::problem("python", found, REINSTALL_ADVICE));
        }
    }
    match home {
        Ok(home) => checks.extend(environment(&home.venv(), state)),
        Err(error) => {
            let advice = "the environments are in envs_py; runs need it";
            checks.push(Check::problem("environment", error.to_string(), advice));
        }
    }
    checks
}

const REINSTALL_ADVICE: &str = "install this Python again (Debian, Ubuntu: apt install python3 \
                                python3-dev python3-venv), or rebuild for another: \
                                PYO3_PYTHON=… cargo build --release";

fn facts() -> Result<Facts, String> {
    let [isolated, no_bytecode, command] = QUIETLY;
    let text = answer(LINKED_PYTHON.executable, &[isolated, no_bytecode, command, QUESTIONS])?;
    serde_json::from_str(&text).map_err(|error| format!("{error}: {text}"))
}

fn interpreter(facts: &Facts) -> Check {
    let (wanted, number) = (LINKED_PYTHON.version, LINKED_PYTHON.version_number());
    if facts.version != wanted || facts.base_prefix != LINKED_PYTHON.base_prefix {
        let found = format!(
            "built for {wanted} in {}, found {} in {}",
            LINKED_PYTHON.base_prefix, facts.version, facts.base_prefix
        );
        return Check::problem("python", found, "rebuild: cargo build --release");
    }
    let role = if host().is_some() { "which runs this program" } else { "as at build time" };
    Check::ok("python", format!("{number}, {}, {role}", LINKED_PYTHON.executable))
}

/// Compares the version of the loaded libpython. It exists: otherwise this program would not have
/// started.
fn library(loaded: &str) -> Check {
    const NAME: &str = "libpython";
    if loaded == LINKED_PYTHON.version {
        return Check::ok(NAME, format!("loaded, built for {}", LINKED_PYTHON.library_dir));
    }
    let found = format!("loaded {loaded}, built for {}", LINKED_PYTHON.version);
    Check::problem(NAME, found, "unset LD_LIBRARY_PATH, or rebuild: cargo build --release")
}

fn headers(facts: &Facts) -> Check {
    const NAME: &str = "python headers";
    if facts.has_headers {
        return Check::ok(NAME, facts.headers.clone());
    }
    let found = format!("no {}", facts.headers);
    let advice = "needed only to build this program, and packages without wheels. Debian, Ubuntu: \
                  apt install python3-dev";
    Check::warning(NAME, found, advice)
}

fn venv_module(facts: &Facts, venv_exists: bool) -> Check {
    const NAME: &str = "python venv";
    let advice = "Debian, Ubuntu: apt install python3-venv";
    match (facts.has_venv, venv_exists) {
        (true, _) => Check::ok(NAME, "modules venv and ensurepip found"),
        (false, true) => Check::warning(NAME, "missing, but .venv exists already", advice),
        (false, false) => Check::problem(NAME, "missing, and needed to create .venv", advice),
    }
}

fn environment(venv: &Path, state: State) -> Vec<Check> {
    const NAME: &str = "environment";
    let path = venv.display();
    match state {
        State::Ready => {
            let packages = packages(venv);
            vec![Check::ok(NAME, format!("ready, {path}")), packages]
        }
        State::Missing => {
            let advice = "the first train creates it, for which it needs the package index or \
                          PIP_FIND_LINKS";
            vec![Check::warning(NAME, format!("not created yet, {path}"), advice)]
        }
        State::Stale(why) => {
            let advice = "the next train updates it, for which it needs the package index";
            vec![Check::warning(NAME, format!("stale, {path}: {why}"), advice)]
        }
    }
}

fn packages(venv: &Path) -> Check {
    const NAME: &str = "packages";
    let [isolated, no_bytecode, command] = QUIETLY;
    match answer(
        PythonEnvironment::of(venv.to_owned()).executable,
        &[isolated, no_bytecode, command, PACKAGES],
    ) {
        // Importing may print; the versions come last.
        Ok(text) => Check::ok(NAME, text.lines().last().unwrap_or_default()),
        Err(error) => {
            let advice = match host() {
                None => format!("rename {}; the next train creates it again", venv.display()),
                Some(host) => {
                    let python = host.executable.display();
                    format!("{python} -m pip install --force-reinstall 'dmprl[sim]'")
                }
            };
            Check::problem(NAME, format!("cannot be imported: {error}"), advice)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Status;
    use super::*;

    fn facts_of_the_build() -> Facts {
        Facts {
            version: LINKED_PYTHON.version.into(),
            base_prefix: LINKED_PYTHON.base_prefix.into(),
            headers: "/usr/include/python3.11/Python.h".into(),
            has_headers: true,
            has_venv: true,
        }
    }

    #[test]
    fn the_interpreter_of_the_build_passes() {
        let facts = facts().unwrap();
        assert_eq!(interpreter(&facts).status, Status::Ok);
        assert_eq!(library(&loaded_python_version()).status, Status::Ok);
    }

    #[test]
    fn another_python_is_a_problem_with_both_versions() {
        let other = Facts { version: "3.10.0 (other)".into(), ..facts_of_the_build() };
        let check = interpreter(&other);
        assert_eq!(check.status, Status::Problem);
        assert!(check.found.contains("3.10.0"), "{check:?}");
        assert!(check.found.contains(LINKED_PYTHON.version), "{check:?}");
        assert_eq!(library("3.10.0 (other)").status, Status::Problem);
        let moved = Facts { base_prefix: "/elsewhere".into(), ..facts_of_the_build() };
        assert_eq!(interpreter(&moved).status, Status::Problem);
    }

    #[test]
    fn missing_headers_are_only_a_warning() {
        let bare = Facts { has_headers: false, has_venv: false, ..facts_of_the_build() };
        assert_eq!(headers(&bare).status, Status::Warning);
        assert_eq!(venv_module(&bare, true).status, Status::Warning);
        assert_eq!(venv_module(&bare, false).status, Status::Problem);
    }

    #[test]
    fn an_environment_without_its_packages_is_a_problem_and_a_missing_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let venv = folder.path().join(".venv");
        let statuses = |state| -> Vec<_> {
            environment(&venv, state).iter().map(|check| check.status).collect()
        };
        assert_eq!(statuses(State::Missing), [Status::Warning]);
        assert_eq!(statuses(State::Stale("moved".into())), [Status::Warning]);
        assert_eq!(statuses(State::Ready), [Status::Ok, Status::Problem]);
    }
}
