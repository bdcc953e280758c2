//! The Python package with its optional extras: readers of demonstrations, panda-gym,
//! Gymnasium-Robotics, huggingface_hub, Optuna, an ONNX runtime, Rerun, TensorBoard's reader,
//! experiment trackers and mypy.
//!
//! They have their own virtual environment, made once: PyBullet is large, most users need none of
//! them, and it has no build for some versions of Python. Tests of packages that cannot be
//! installed are skipped.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use dmprl_actors::python_env::LINKED_PYTHON;
use dmprl_run::failure::Outcome;
use dmprl_run::{PolicyChoice, RunDirectory};
use dmprl_supervisor::{ObservationPlan, observe};
use dmprl_tests::program::{Workplace, executable};
use dmprl_tests::skipped::skipped;
use dmprl_tests::{exported, project_root, venv};

/// Extras of `envs_py/pyproject.toml`, from all to one, with the tests that need them.
const ATTEMPTS: [(&str, &str); 2] = [
    ("test", "test_*.py"),
    (
        "demos,frames,hub,onnx,rerun,robotics,search,tensorboard,trackers,types",
        "test_[dfhorst]*.py",
    ),
];
/// PyBullet has builds only for this version.
const REMEDY: &str = "PYO3_PYTHON=python3.11 on x86-64, with a network";
/// Messages of pip when a package has no build for this Python, or the network is unreachable.
const NOT_AVAILABLE: [&str; 2] = ["No matching distribution found", "Could not find a version"];

#[test]
fn unit_tests_of_the_optional_extras_pass() {
    for (extra, tests) in ATTEMPTS {
        match environment_with(extra) {
            Ok(python) => return run_tests(&python, tests),
            Err(reason) => {
                let what = format!("the Python extras `{extra}` ({reason})");
                skipped("TEST_EXTRAS_REQUIRED", &what, REMEDY);
            }
        }
    }
}

/// Returns an interpreter with `envs_py[extra]`, from an earlier run if nothing has changed, or the
/// reason why the packages cannot be installed.
fn environment_with(extra: &str) -> Result<PathBuf, String> {
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("extras-venv-{extra}"));
    let python = venv.join("bin/python");
    let package = project_root().join("envs_py");
    let requirements = fs::read_to_string(package.join("pyproject.toml")).unwrap();
    let stamp = format!("{}\n{}\n{requirements}", LINKED_PYTHON.executable, package.display());
    let stamp_path = venv.join("stamp.txt");
    if fs::read_to_string(&stamp_path).is_ok_and(|found| found == stamp) {
        return Ok(python);
    }

    if venv.exists() {
        fs::remove_dir_all(&venv).unwrap();
    }
    let made = Command::new(LINKED_PYTHON.executable)
        .args(["-I", "-m", "venv"])
        .arg(&venv)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", report(&made));
    let installed = Command::new(&python)
        .args(["-I", "-m", "pip", "install", "--disable-pip-version-check", "--no-input"])
        // Without builds from source, because compiling PyBullet takes minutes. With few retries,
        // so that a machine without a network does not wait.
        .args(["--quiet", "--only-binary", ":all:", "--retries", "1", "--timeout", "15"])
        .arg("--editable")
        .arg(format!("{}[{extra}]", package.display()))
        .env("PIP_USER", "0")
        .env_remove("PIP_TARGET")
        .env_remove("PIP_PREFIX")
        .output()
        .unwrap();
    if installed.status.success() {
        fs::write(&stamp_path, stamp).unwrap();
        return Ok(python);
    }
    let report = report(&installed);
    let reason = report.lines().find(|line| NOT_AVAILABLE.iter().any(|text| line.contains(text)));
    Err(reason.unwrap_or_else(|| panic!("{report}")).trim().to_owned())
}

fn run_tests(python: &Path, tests: &str) {
    let (exported, place) = (tempfile::tempdir().unwrap(), Workplace::new());
    exported::write(exported.path());
    let run = trained(&place);
    let output = Command::new(python)
        .env("TEST_EXPORTED", exported.path())
        .env("TEST_RUN", &run)
        .env("TEST_OBSERVED", observed(&place, &run))
        .args(["-m", "unittest", "discover", "--start-directory", "envs_py/tests_extras"])
        .args(["--pattern", tests])
        .current_dir(project_root())
        .output()
        .unwrap();
    let report = report(&output);
    assert!(output.status.success(), "{report}");
    assert!(!report.contains("Ran 0 tests"), "{report}");
}

/// A resumed run.
fn trained(place: &Workplace) -> String {
    let run = place.path("run");
    let settings = [
        "policy.hidden=[32]",
        "algorithm.critic_hidden=[32]",
        "exploration.warm_up_steps=500",
        "evaluation.episodes=2",
        "evaluation.interval_steps=500",
        "checkpoint.interval_steps=500",
        "metrics.interval_steps=250",
    ];
    let mut arguments = vec!["train", "reacher", "--run-dir", &run, "--steps", "1500"];
    settings.iter().for_each(|setting| arguments.extend(["--set", setting]));
    place.run(&arguments).with_status(0);
    place.run(&["resume", &run, "--steps", "2500"]).with_status(0);
    run
}

/// The file of an observer of the run's latest policy: two episodes with details, from seed 1000.
fn observed(place: &Workplace, run: &str) -> String {
    let run = RunDirectory::open(Path::new(run)).unwrap();
    let output = place.path("episodes.jsonl");
    let plan = ObservationPlan {
        program: executable().to_path_buf(),
        run: &run,
        venv: Some(venv().venv.clone()),
        policy_version: run.choose_policy(PolicyChoice::Latest).unwrap().version,
        first_seed: 1_000,
        episodes: 2,
        output: PathBuf::from(&output),
        pictures: None,
        details: true,
    };
    assert_eq!(observe(plan, &|_, _| ()).unwrap(), Outcome::Done);
    output
}

fn report(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).trim().to_owned()
}
