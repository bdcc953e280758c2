//! `dmprl clean` and the report of `dmprl doctor`, with live and dead runs.

use std::fs;
use std::path::{Path, PathBuf};

use dmprl_tests::program::{Finished, Running, Workplace, shared_memory_of, until};
use rustix::process::Signal;

use crate::{ENDLESS, train};

fn training(place: &Workplace, run: &str) -> Running {
    let mut running = place.start(&train("reacher", run, &["--steps", ENDLESS]));
    running.until_steps(run, 500);
    running
}

/// Returns true if a report of `clean --json` names the shared memory of a run.
fn names(report: &Finished, domain: &Path) -> bool {
    let report = report.json();
    let listed = report["leftovers"].as_array().unwrap();
    listed.iter().any(|leftover| leftover["path"].as_str() == domain.to_str())
}

/// Other tests start and kill runs at the same time, so only these two runs are checked.
#[test]
fn clean_removes_what_a_killed_run_left_and_nothing_of_a_living_one() {
    let (place, other_place) = (Workplace::new(), Workplace::new());
    let (run, other) = (place.path("run"), other_place.path("other"));
    // The live one first: a start removes the files of dead runs.
    let mut living = training(&other_place, &other);
    let killed = training(&place, &run);
    let (dead, alive) = (shared_memory_of(&run), shared_memory_of(&other));
    assert_eq!((dead.len(), alive.len()), (1, 1));
    killed.signal_group(Signal::KILL);
    drop(killed);
    place.until_no_process();

    // It still exists, unless the start of another test was faster. A start that is removing it
    // holds its locks.
    until("the killed run's files are listed or gone", || {
        let listed = place.run(&["clean", "--dry-run", "--json"]).with_status(0);
        assert!(!names(&listed, &alive[0]), "{}", listed.printed);
        names(&listed, &dead[0]) || shared_memory_of(&run).is_empty()
    });
    let removed = place.run(&["clean"]).with_status(0);
    assert!(removed.printed.contains("dead runs"), "{}", removed.printed);
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
    assert!(Path::new(&run).join("manifest.json").is_file(), "results stay");

    assert_eq!(shared_memory_of(&other), alive);
    let steps = dmprl_tests::program::env_steps_of(&other).unwrap();
    living.until_steps(&other, steps + 1_000);
    living.signal_group(Signal::INT);
    living.wait().with_status(130);
}

/// The supervisor owns the shared memory, but its learner still has to write a checkpoint.
#[test]
fn clean_leaves_the_learner_of_a_killed_supervisor_its_shared_memory() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run);
    let domain = shared_memory_of(&run);
    let learner = place.process("learner");
    learner.signal(Signal::STOP);
    running.signal(Signal::KILL);
    running.wait();
    let removed = place.run(&["clean", "--json"]).with_status(0);
    assert!(!names(&removed, &domain[0]), "{}", removed.printed);
    assert_eq!(shared_memory_of(&run), domain);
    learner.signal(Signal::CONT);
    place.until_no_process();
    place.run(&["clean"]).with_status(0);
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
}

#[test]
fn doctor_tells_what_it_found_and_changes_nothing() {
    let place = Workplace::new();
    let report = place.run(&["doctor", "--json"]);
    let checks = report.json()["checks"].as_array().unwrap().clone();
    let check = |name: &str| {
        let check = checks.iter().find(|check| check["name"] == name);
        check.unwrap_or_else(|| panic!("no {name} in {checks:#?}")).clone()
    };
    for name in ["platform", "python", "libpython", "environment", "packages", "open files"] {
        assert_eq!(check(name)["status"], "ok", "{}", check(name));
    }
    let packages = check("packages")["found"].as_str().unwrap().to_owned();
    for package in ["gymnasium", "mujoco", "numpy"] {
        assert!(packages.contains(package), "{packages}");
    }
    assert!(check("shared memory")["found"].as_str().unwrap().contains("default run with"));
    let problems = report.json()["problems"].as_u64().unwrap();
    let report = report.with_status(i32::from(problems > 0));
    assert_eq!(report.said.is_empty(), problems == 0, "{}", report.said);
    let text = place.run(&["doctor"]).printed;
    checks.iter().for_each(|check| assert!(text.contains(check["name"].as_str().unwrap())));
    assert_eq!(fs::read_dir(place.folder()).unwrap().count(), 0);
}

#[test]
fn doctor_fails_where_a_limit_is_too_low_for_a_run() {
    let place = Workplace::new();
    let program = dmprl_tests::program::executable().display();
    let mut command = std::process::Command::new("sh");
    command.args(["-c", &format!("ulimit -n 40; exec {program} doctor --json")]);
    let report = place.start_command(command).wait().with_status(1).saying("problem");
    let report = report.json();
    let checks = report["checks"].as_array().unwrap();
    let files = checks.iter().find(|check| check["name"] == "open files").unwrap();
    assert_eq!(files["status"], "problem", "{files}");
    assert!(files["found"].as_str().unwrap().starts_with("at most 40;"), "{files}");
    assert!(files["advice"].as_str().unwrap().contains("ulimit -n"), "{files}");
}
