//! Ctrl-C, once and twice, in normal and in broken runs.

use std::path::Path;
use std::process::Command;

use dmprl_tests::program::{
    Running, Workplace, env_steps, env_steps_of_checkpoint, executable, rows, shared_memory_of,
};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::{ENDLESS, train};

/// Flags of a run that only an interrupt ends.
const EVENTS: [&str; 4] = ["--steps", ENDLESS, "--events", "json"];

/// The last event of an interrupted run whose checkpoint has its last step.
fn interrupted() -> Value {
    json!({ "event": "finished", "outcome": "interrupted", "checkpointed": true })
}

fn training(place: &Workplace, run: &str) -> Running {
    let mut running = place.start(&train("reacher", run, &EVENTS));
    running.until_steps(run, 1_500);
    running
}

fn assert_nothing_left(place: &Workplace, run: &str) {
    place.assert_no_process();
    assert_eq!(shared_memory_of(run), Vec::<std::path::PathBuf>::new());
}

#[test]
fn ctrl_c_once_writes_a_checkpoint_that_the_run_goes_on_from() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run);
    running.signal_group(Signal::INT);
    running.wait().with_status(130).with_event(&interrupted());
    assert_nothing_left(&place, &run);
    let steps = env_steps_of_checkpoint(&run).unwrap();
    let metrics = rows(&run, "metrics.jsonl");
    assert_eq!(env_steps(&metrics).last(), Some(&steps), "the checkpoint is of the last moment");

    let end = (steps + 1_000).to_string();
    place.run(&["resume", &run, "--steps", &end]).with_status(0);
    let after = rows(&run, "metrics.jsonl");
    assert_eq!(after[..metrics.len()], metrics, "not one step is done again");
    assert_eq!(env_steps(&after).last(), Some(&(steps + 1_000)));
}

#[test]
fn sigterm_is_an_interrupt_too() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run);
    // To the supervisor alone, as a service manager does.
    running.signal(Signal::TERM);
    running.wait().with_status(130).with_event(&interrupted());
    assert_nothing_left(&place, &run);
}

/// `ssh` and a closed terminal send SIGHUP. `nohup` makes a program ignore it.
#[test]
fn loss_of_the_terminal_is_an_interrupt_unless_it_is_ignored() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run);
    running.signal_group(Signal::HUP);
    running.wait().with_status(130).with_event(&interrupted());
    assert_nothing_left(&place, &run);

    let run = place.path("ignored");
    let mut command = Command::new("nohup");
    command.arg(executable()).args(train("reacher", &run, &EVENTS));
    let mut running = place.start_command(command);
    running.until_steps(&run, 1_500);
    running.signal_group(Signal::HUP);
    running.until_steps(&run, 4_000);
    running.signal_group(Signal::INT);
    running.wait().with_status(130).with_event(&interrupted());
    assert_nothing_left(&place, &run);
}

#[test]
fn ctrl_c_before_the_first_step_leaves_nothing_running() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&train("reacher", &run, &EVENTS));
    running.until_event(&json!({ "event": "started" }));
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    assert_nothing_left(&place, &run);
    place
        .run(&["resume", &run, "--steps", "1000"])
        .with_status(0)
        .saying("starts from the beginning");
}

/// The learner hangs, so that only the second interrupt can end the run at once.
#[test]
fn ctrl_c_twice_ends_a_run_whose_learner_hangs() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run);
    place.process("learner").signal(Signal::STOP);
    // Read only now: until it was stopped, the learner could write a checkpoint.
    let before = env_steps_of_checkpoint(&run);
    running.signal_group(Signal::INT);
    running.until_event(&json!({ "event": "interrupted" }));
    // Two signals at almost the same time can merge, so the second is repeated.
    running.until("the second interrupt", |running| {
        running.signal_group(Signal::INT);
        running.events().iter().any(|event| event["event"] == "killed")
    });
    let killed = json!({ "event": "killed", "reason": "interrupted twice" });
    running.wait().with_status(130).with_event(&killed);
    assert_nothing_left(&place, &run);
    assert_eq!(env_steps_of_checkpoint(&run), before, "the checkpoint before is still there");
}

#[test]
fn ctrl_c_once_ends_a_run_whose_worker_hangs_and_writes_the_checkpoint() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run);
    place.process("actor").signal(Signal::STOP);
    running.signal_group(Signal::INT);
    let killed = json!({ "event": "killed", "processes": ["actor-0"] });
    running.wait().with_status(130).with_event(&killed).with_event(&interrupted());
    assert_nothing_left(&place, &run);
}

#[test]
fn ctrl_c_during_eval_leaves_the_run_as_it_is() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    let running = place.start(&["eval", &run, "--episodes", "1000000"]);
    let mut running = running;
    running.until("an evaluator", |_| {
        place.processes().iter().any(|process| process.role == "evaluator")
    });
    running.signal_group(Signal::INT);
    assert_eq!(running.wait().with_status(130).printed, "");
    place.assert_no_process();
    assert_eq!(rows(&run, "evaluations.jsonl").len(), 1);
    assert!(Path::new(&run).join("logs/eval.log").is_file());
}
