//! The interpreter that this program was built for, and the `.venv` that was made with it.

use std::path::Path;

use dmprl_actors::python_env::{LINKED_PYTHON, loaded_python_version};
use dmprl_supervisor::answer;
use dmprl_supervisor::python_setup::{Home, State};
use serde::Deserialize;

use super::Check;

/// What the interpreter is asked. `find_spec` imports nothing.
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
/// What `.venv` is asked: only an import shows that a package fits the machine.
const PACKAGES: &str = "\
import gymnasium, mujoco, numpy, dmprl
print('gymnasium', gymnasium.__version__ + ',',
      'mujoco', mujoco.__version__ + ',', 'numpy', numpy.__version__)";
/// Isolated, and without writing what it has compiled.
const QUIETLY: [&str; 3] = ["-I", "-B", "-c"];

/// What the interpreter answers.
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
    let made = home.as_ref().map_or(State::Missing, Home::state);
    match facts() {
        Ok(facts) => checks.extend([
            interpreter(&facts),
            library(&loaded_python_version()),
            headers(&facts),
            venv_module(&facts, made == State::Ready),
        ]),
        Err(error) => {
            let found = format!("{}: {error}", LINKED_PYTHON.executable);
            checks.push(Check::problem("python", found, BUILD_AGAIN));
        }
    }
    match home {
        Ok(home) => checks.extend(environment(&home.venv(), made)),
        Err(error) => {
            let advice = "without envs_py there are no environments";
            checks.push(Check::problem("environment", error.to_string(), advice));
        }
    }
    checks
}

const BUILD_AGAIN: &str = "install that Python again (Debian, Ubuntu: apt install python3 \
                           python3-dev python3-venv), or build for another: \
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
        return Check::problem("python", found, "build again: cargo build --release");
    }
    Check::ok("python", format!("{number}, {}, as built for", LINKED_PYTHON.executable))
}

/// That it is there at all is certain: the program would not have started.
fn library(loaded: &str) -> Check {
    const NAME: &str = "libpython";
    if loaded == LINKED_PYTHON.version {
        return Check::ok(NAME, format!("loaded, built for {}", LINKED_PYTHON.library_dir));
    }
    let found = format!("loaded is {loaded}, built for {}", LINKED_PYTHON.version);
    Check::problem(NAME, found, "unset LD_LIBRARY_PATH, or build again: cargo build --release")
}

fn headers(facts: &Facts) -> Check {
    const NAME: &str = "python headers";
    if facts.has_headers {
        return Check::ok(NAME, facts.headers.clone());
    }
    let found = format!("no {}", facts.headers);
    let advice = "this program runs; the next build, or a package that has to be compiled, may \
                  not. Debian, Ubuntu: apt install python3-dev";
    Check::warning(NAME, found, advice)
}

fn venv_module(facts: &Facts, is_made: bool) -> Check {
    const NAME: &str = "python venv";
    let advice = "Debian, Ubuntu: apt install python3-venv";
    match (facts.has_venv, is_made) {
        (true, _) => Check::ok(NAME, "modules venv and ensurepip are there"),
        (false, true) => Check::warning(NAME, "missing, but .venv is made already", advice),
        (false, false) => Check::problem(NAME, "missing, and .venv is not made yet", advice),
    }
}

fn environment(venv: &Path, made: State) -> Vec<Check> {
    const NAME: &str = "environment";
    let path = venv.display();
    match made {
        State::Ready => {
            let packages = packages(venv);
            vec![Check::ok(NAME, format!("ready, {path}")), packages]
        }
        State::Missing => {
            let advice =
                "the first train makes it, which needs the package index or PIP_FIND_LINKS";
            vec![Check::warning(NAME, format!("not made yet, {path}"), advice)]
        }
        State::Stale(why) => {
            let advice = "the next train makes it fit, which needs the package index";
            vec![Check::warning(NAME, format!("stale, {path}: {why}"), advice)]
        }
    }
}

fn packages(venv: &Path) -> Check {
    const NAME: &str = "packages";
    let [isolated, no_bytecode, command] = QUIETLY;
    match answer(venv.join("bin/python"), &[isolated, no_bytecode, command, PACKAGES]) {
        // Importing may print; the versions come last.
        Ok(text) => Check::ok(NAME, text.lines().last().unwrap_or_default()),
        Err(error) => {
            let advice = format!("remove {}; the next train makes it anew", venv.display());
            Check::problem(NAME, format!("cannot be imported: {error}"), advice)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Status;
    use super::*;

    fn as_built_for() -> Facts {
        Facts {
            version: LINKED_PYTHON.version.into(),
            base_prefix: LINKED_PYTHON.base_prefix.into(),
            headers: "/usr/include/python3.11/Python.h".into(),
            has_headers: true,
            has_venv: true,
        }
    }

    #[test]
    fn the_interpreter_that_built_this_is_the_right_one() {
        let facts = facts().unwrap();
        assert_eq!(interpreter(&facts).status, Status::Ok);
        assert_eq!(library(&loaded_python_version()).status, Status::Ok);
    }

    #[test]
    fn another_python_is_a_problem_with_both_versions() {
        let other = Facts { version: "3.10.0 (other)".into(), ..as_built_for() };
        let check = interpreter(&other);
        assert_eq!(check.status, Status::Problem);
        assert!(check.found.contains("3.10.0"), "{check:?}");
        assert!(check.found.contains(LINKED_PYTHON.version), "{check:?}");
        assert_eq!(library("3.10.0 (other)").status, Status::Problem);
        let moved = Facts { base_prefix: "/elsewhere".into(), ..as_built_for() };
        assert_eq!(interpreter(&moved).status, Status::Problem);
    }

    #[test]
    fn what_only_a_build_needs_is_no_problem_of_a_run() {
        let bare = Facts { has_headers: false, has_venv: false, ..as_built_for() };
        assert_eq!(headers(&bare).status, Status::Warning);
        assert_eq!(venv_module(&bare, true).status, Status::Warning);
        assert_eq!(venv_module(&bare, false).status, Status::Problem);
    }

    #[test]
    fn an_environment_without_its_packages_is_a_problem_and_a_missing_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let venv = folder.path().join(".venv");
        let statuses = |made| -> Vec<_> {
            environment(&venv, made).iter().map(|check| check.status).collect()
        };
        assert_eq!(statuses(State::Missing), [Status::Warning]);
        assert_eq!(statuses(State::Stale("moved".into())), [Status::Warning]);
        assert_eq!(statuses(State::Ready), [Status::Ok, Status::Problem]);
    }
}
