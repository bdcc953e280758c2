//! Sends real signals to a real supervisor process with fake children.
//!
//! The supervisor process is this test program, started again for the test `supervisor_process`.
#![allow(clippy::unwrap_used)] // helpers of tests fail as tests do

mod fakes;

use std::cell::RefCell;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use dmprl::terminal::{Display, ProgressStyle};
use dmprl_run::RunDirectory;
use dmprl_supervisor::{Ending, TimeLimits, interrupts, supervise};
use fakes::{Fixture, living_children, until};
use rustix::process::{Pid, Signal, kill_process};

/// Environment variable with the run directory of the supervisor process.
const RUN: &str = "SUPERVISOR_TEST_RUN";

/// The supervisor process of the other tests. Without their environment variable it tests nothing.
#[test]
fn supervisor_process() {
    let Some(run) = std::env::var_os(RUN).map(PathBuf::from) else { return };
    let run = RunDirectory::open(&run).unwrap();
    let config = run.config().unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let report = runtime.block_on(async {
        let interrupts = interrupts().unwrap();
        let plan = fakes::plan(&run, &config, TimeLimits::default(), false, interrupts);
        let mut display = Display::new(ProgressStyle::Lines, config.run.steps);
        supervise(plan, &mut display).await
    });
    std::process::exit(match report.ending {
        Ending::Completed => 0,
        Ending::Interrupted => 130,
        Ending::Failed(_) => 1,
    });
}

fn start(fixture: &Fixture) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "supervisor_process", "--nocapture"])
        .env(RUN, fixture.run.path())
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

fn signal(child: &Child, signal: Signal) {
    let pid = Pid::from_raw(i32::try_from(child.id()).unwrap()).unwrap();
    kill_process(pid, signal).unwrap();
}

fn seen(run: &Path, name: &str) -> String {
    let path = run.join("fake").join(format!("{name}.seen"));
    std::fs::read_to_string(path).unwrap_or_default()
}

/// Waits until the workers are attached and the evaluator has received a request.
fn until_training(fixture: &Fixture) {
    let run = fixture.run.path();
    until("a run under way", || {
        ["actor-0", "actor-1"].iter().all(|name| seen(run, name).contains("attach"))
            && seen(run, "evaluator").contains("evaluate")
    });
}

#[test]
fn sigint_and_sigterm_end_the_run_with_a_checkpoint_and_130() {
    for kind in [Signal::INT, Signal::TERM] {
        let fixture = Fixture::new(&[("learner", "until-stopped")]);
        let mut supervisor = start(&fixture);
        until_training(&fixture);
        signal(&supervisor, kind);
        assert_eq!(supervisor.wait().unwrap().code(), Some(130));
        assert!(fixture.seen("learner").contains("stop"));
        fixture.assert_no_child_lives();
    }
}

#[test]
fn a_second_sigint_kills_children_that_ignore_stop_at_once() {
    let fixture = Fixture::new(&[("learner", "until-stopped"), ("actor-0", "stubborn")]);
    let supervisor = start(&fixture);
    until("a learner", || fixture.seen("learner").contains("started"));
    until("an evaluator", || fixture.seen("evaluator").contains("evaluate"));
    signal(&supervisor, Signal::INT);
    until("a stop", || fixture.seen("learner").contains("stop"));
    // Two signals within a short time count as one, so the second is repeated.
    let supervisor = RefCell::new(supervisor);
    until("the end", || {
        signal(&supervisor.borrow(), Signal::INT);
        supervisor.borrow_mut().try_wait().unwrap().is_some()
    });
    assert_eq!(supervisor.borrow_mut().wait().unwrap().code(), Some(130));
    fixture.assert_no_child_lives();
}

#[test]
fn children_exit_after_the_supervisor_is_killed_and_the_learner_saves_first() {
    let fixture = Fixture::new(&[("learner", "until-stopped")]);
    let mut supervisor = start(&fixture);
    until_training(&fixture);
    supervisor.kill().unwrap();
    assert_eq!(supervisor.wait().unwrap().signal(), Some(9));
    until("no child", || living_children(fixture.run.path()).is_empty());
    assert!(fixture.run.path().join("fake/orphaned").exists());
}
