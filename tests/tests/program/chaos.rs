//! `dmprl chaos` with real processes: a short trial; a release runs one of half an hour.

use std::path::PathBuf;
use std::process::Command;

use dmprl_tests::program::{Running, Workplace, executable, processes_naming, shared_memory_of};
use rustix::process::Signal;

/// Starts a trial with its temporary files in the test's folder.
fn chaos(place: &Workplace, more: &[&str]) -> Running {
    let temporary = place.path("tmp");
    std::fs::create_dir_all(&temporary).unwrap();
    let mut command = Command::new(executable());
    command.arg("chaos").args(more).env("TMPDIR", temporary);
    place.start_command(command)
}

fn assert_nothing_left(place: &Workplace) {
    place.until_no_process();
    assert_eq!(std::fs::read_dir(place.path("tmp")).unwrap().count(), 0, "temporary files");
}

#[test]
fn whoever_is_killed_nothing_is_lost_nothing_comes_twice_and_nothing_is_left() {
    let place = Workplace::new();
    // The trial takes longer than that on a slow machine: it continues until so many are killed.
    let kills = ["--worker-kills", "5", "--learner-kills", "2"];
    let more = [&["--seed", "1", "--seconds", "20", "--json"][..], &kills].concat();
    let json = chaos(&place, &more).wait().with_status(0).json();
    let count = |key: &str| json[key].as_u64().unwrap_or_else(|| panic!("{key}: {json}"));
    assert!(count("worker_kills") >= 5 && count("learner_kills") >= 2, "{json}");
    assert!(count("inserted") > 1_000 && count("checkpoints") > 1, "{json}");
    assert_eq!(json["violations"].as_array().unwrap().len(), 0, "{json}");
    assert_eq!(count("lost"), 0, "{json}");
    let accounted = count("inserted") + count("rejected") + count("in_flight");
    assert_eq!(count("produced"), accounted, "{json}");
    // Not tested: the time of a recovery on a loaded machine.
    assert!(json["worker_back_s"]["p50"].as_f64() > Some(0.0), "{json}");
    assert!(json["learner_back_s"]["p50"].as_f64() > Some(0.0), "{json}");
    assert_nothing_left(&place);
}

#[test]
fn ctrl_c_ends_a_trial_with_the_report_so_far() {
    let place = Workplace::new();
    let output = place.path("trial");
    let mut running = chaos(&place, &["--seconds", "3600", "--json", "--output", &output]);
    running.until("a first death", |_| {
        let log = std::fs::read_to_string(place.folder().join("trial/train.log"));
        log.unwrap_or_default().contains("died (signal 9 (SIGKILL)")
    });
    running.signal(Signal::INT);
    let json = running.wait().with_status(130).json();
    assert_eq!(json["violations"].as_array().unwrap().len(), 0, "{json}");
    assert_eq!((&json["interrupted"], &json["lost"]), (&true.into(), &0.into()), "{json}");
    let run = format!("{output}/run");
    assert_eq!(json["kept"], output);
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
    assert_nothing_left(&place);
}

/// The run has its own session, but does not outlive the trial.
#[test]
fn a_killed_trial_takes_its_run_with_it() {
    let place = Workplace::new();
    let output = place.path("trial");
    let mut running = chaos(&place, &["--seconds", "3600", "--output", &output]);
    let train = || processes_naming(&output).iter().any(|process| process.role == "learner");
    running.until("a learner", |_| train());
    running.signal(Signal::KILL);
    running.wait();
    place.until_no_process();
}
