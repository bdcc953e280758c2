//! SIGKILL to all processes, to the supervisor, to a worker, to the learner.

use std::path::PathBuf;
use std::time::Instant;

use dmprl_tests::program::{
    Running, Workplace, env_steps, env_steps_of, env_steps_of_checkpoint, rows, shared_memory_of,
    until,
};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::{ENDLESS, train};

/// `checkpoint.interval_steps` of these runs, and the segment by which it may be exceeded.
const CHECKPOINT_INTERVAL: u64 = 1_000 + 5;

fn training(place: &Workplace, run: &str, more: &[&str]) -> Running {
    let more = [&["--steps", ENDLESS, "--events", "json"][..], more].concat();
    let mut running = place.start(&train("reacher", run, &more));
    running.until_steps(run, 2_500);
    running
}

/// The event of the first death of a process, which is restarted.
fn death(process: &str, how: &str) -> Value {
    json!({ "event": "child_died", "process": process, "how": how, "restart": 1 })
}

/// Resumes for some more steps and checks the whole curve.
fn resume_and_check_curve(place: &Workplace, run: &str, reached: u64) {
    let checkpoint = env_steps_of_checkpoint(run).unwrap();
    // The newest checkpoint may be incomplete and is then ignored; the one before is used.
    assert!(
        checkpoint + 2 * CHECKPOINT_INTERVAL >= reached,
        "{checkpoint} of {reached} steps are left"
    );
    let kept: Vec<_> = rows(run, "metrics.jsonl")
        .into_iter()
        .filter(|row| row["env_steps"].as_u64().unwrap() <= checkpoint)
        .collect();
    let end = (checkpoint + 2_000).to_string();
    place.run(&["resume", run, "--steps", &end]).with_status(0);
    let metrics = rows(run, "metrics.jsonl");
    assert_eq!(metrics[..kept.len()], kept, "the curve before the checkpoint stays");
    assert!(env_steps(&metrics)[kept.len()] >= checkpoint);
    assert_eq!(env_steps(&metrics).last(), Some(&(checkpoint + 2_000)));
    for file in ["metrics.jsonl", "evaluations.jsonl"] {
        let steps = env_steps(&rows(run, file));
        assert!(steps.is_sorted_by(|a, b| a < b), "{file}: {steps:?}");
    }
    assert_eq!(env_steps(&rows(run, "evaluations.jsonl")).last(), Some(&(checkpoint + 2_000)));
    place.assert_no_process();
    assert_eq!(shared_memory_of(run), Vec::<PathBuf>::new());
}

#[test]
fn a_run_killed_as_a_whole_goes_on_from_its_checkpoint_beside_a_living_one() {
    let (place, other_place) = (Workplace::new(), Workplace::new());
    let (run, other) = (place.path("run"), other_place.path("other"));
    let running = training(&place, &run, &[]);
    assert_eq!(shared_memory_of(&run).len(), 1);
    running.signal_group(Signal::KILL);
    assert_eq!(running.wait().status.code(), None);
    place.until_no_process();

    // The next start removes the dead run's shared memory, and nothing of a live run.
    let mut living = training(&other_place, &other, &[]);
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
    let domain = shared_memory_of(&other);
    assert_eq!(domain.len(), 1);
    resume_and_check_curve(&place, &run, env_steps_of(&run).unwrap());
    assert_eq!(shared_memory_of(&other), domain);
    let steps = env_steps_of(&other).unwrap();
    living.until_steps(&other, steps + 1_000);
    living.signal_group(Signal::INT);
    living.wait().with_status(130);
    assert_eq!(shared_memory_of(&other), Vec::<PathBuf>::new());
}

#[test]
fn when_the_supervisor_is_killed_its_children_end_and_the_learner_leaves_a_checkpoint() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run, &[]);
    running.signal(Signal::KILL);
    let reached = env_steps_of(&run).unwrap();
    running.wait();
    place.until_no_process();
    let checkpoint = env_steps_of_checkpoint(&run).unwrap();
    assert!(checkpoint >= reached, "a checkpoint at {checkpoint}, metrics up to {reached}");
    resume_and_check_curve(&place, &run, reached);
}

#[test]
fn resume_waits_for_the_learner_of_a_killed_supervisor() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run, &[]);
    place.process("learner").signal(Signal::STOP);
    running.signal(Signal::KILL);
    running.wait();
    let reached = env_steps_of(&run).unwrap();
    let mut resuming = place.start(&["resume", &run]);
    resuming.until_said("waiting up to");
    place.process("learner").signal(Signal::CONT);
    // Training continues from a checkpoint that the old learner wrote in the meantime.
    resuming.until_steps(&run, reached + 2_000);
    resuming.signal_group(Signal::INT);
    resuming.wait().with_status(130);
    let steps = env_steps(&rows(&run, "metrics.jsonl"));
    assert!(steps.is_sorted_by(|a, b| a < b), "{steps:?}");
    place.assert_no_process();
}

#[test]
fn a_run_whose_learner_sleeps_for_a_while_goes_on() {
    let place = Workplace::new();
    let run = place.path("run");
    // A worker that waits for the learner counts as alive, however long that takes.
    let keys = ["actors.send_deadline_s=0.5", "supervision.heartbeat_timeout_s=5"];
    let keys: Vec<&str> = keys.into_iter().flat_map(|key| ["--set", key]).collect();
    let mut running = training(&place, &run, &keys);
    let workers = ids(&place, "actor");
    place.process("learner").signal(Signal::STOP);
    running.until_said("waited 7 s: its queue is full");
    place.process("learner").signal(Signal::CONT);
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 2_000);
    assert_eq!(ids(&place, "actor"), workers, "{}", running.said());
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert!(last["rejected"].as_object().unwrap().values().all(|count| count == 0), "{last}");
}

#[test]
fn a_killed_worker_is_announced_and_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &[]);
    place.process("actor").signal(Signal::KILL);
    running.until_event(&death("actor-0", "died"));
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 1_500);
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    let refused = last["rejected"].as_object().unwrap();
    assert!(refused.values().all(|count| count == 0), "{last}");
    place.assert_no_process();
}

#[test]
fn a_worker_that_somebody_stopped_is_said_to_hang_and_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &["--set", "supervision.heartbeat_timeout_s=5"]);
    place.process("actor").signal(Signal::STOP);
    running.until_event(&death("actor-0", "hung"));
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 1_500);
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    assert_eq!(rows(&run, "metrics.jsonl").pop().unwrap()["lost"], 0);
    place.assert_no_process();
}

#[test]
fn learner_that_hangs_is_killed_and_replaced_from_its_checkpoint() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &["--set", "supervision.learner_timeout_s=5"]);
    let workers = ids(&place, "actor");
    place.process("learner").signal(Signal::STOP);
    running.until_event(&death("learner", "hung"));
    running.until_event(&json!({ "event": "first_step", "after_restart": true }));
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 1_500);
    assert_eq!(ids(&place, "actor"), workers, "{}", running.said());
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    assert_eq!(rows(&run, "metrics.jsonl").pop().unwrap()["learner_restarts"], 1);
    place.assert_no_process();
}

/// Ctrl-Z or a paused container stops all processes; none is blamed for the silence.
#[test]
fn a_run_that_stands_still_as_a_whole_blames_nobody() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &["--set", "supervision.heartbeat_timeout_s=3"]);
    let workers = ids(&place, "actor");
    running.signal_group(Signal::STOP);
    // Longer than the heartbeat limit, and than the delay at which the supervisor detects its own
    // suspension.
    let stopped = Instant::now();
    until("time enough for a worker to be blamed", || stopped.elapsed().as_secs() >= 7);
    running.signal_group(Signal::CONT);
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 2_000);
    assert_eq!(ids(&place, "actor"), workers, "{}", running.said());
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
}

#[test]
fn workers_that_are_killed_all_at_once_are_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &["--workers", "2"]);
    let workers: Vec<_> =
        place.processes().into_iter().filter(|process| process.role == "actor").collect();
    assert_eq!(workers.len(), 2);
    workers.iter().for_each(|worker| worker.signal(Signal::KILL));
    running.until_event(&death("actor-0", "died"));
    running.until_event(&death("actor-1", "died"));
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 2_000);
    assert_eq!(ids(&place, "actor").len(), 2);
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(last["lost"], 0, "{last}");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
}

#[test]
fn a_killed_evaluator_answers_after_its_restart() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &[]);
    place.process("evaluator").signal(Signal::KILL);
    running.until_event(&death("evaluator", "died"));
    let rows_before = rows(&run, "evaluations.jsonl").len();
    running.until("another row", |_| rows(&run, "evaluations.jsonl").len() > rows_before);
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    let steps = env_steps(&rows(&run, "evaluations.jsonl"));
    assert!(steps.is_sorted_by(|a, b| a < b), "{steps:?}");
}

/// Returns the processes of one role, by their ids.
fn ids(place: &Workplace, role: &str) -> Vec<i32> {
    let processes = place.processes().into_iter().filter(|process| process.role == role);
    processes.map(|process| process.id.as_raw_nonzero().get()).collect()
}

/// Kills the learner, and waits for the next one's first segment and some of its steps.
fn replace_learner(place: &Workplace, run: &str, running: &mut Running, deaths: usize) {
    place.process("learner").signal(Signal::KILL);
    let back = |running: &Running| {
        let events = running.events();
        events.iter().filter(|event| event["after_restart"] == true).count() == deaths
    };
    running.until("a new learner", back);
    let steps = env_steps_of(run).unwrap_or(0);
    running.until_steps(run, steps + 2_000);
}

#[test]
fn a_killed_learner_is_replaced_and_its_workers_stay() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, &[]);
    let workers = ids(&place, "actor");
    replace_learner(&place, &run, &mut running, 1);
    replace_learner(&place, &run, &mut running, 2);
    assert_eq!(ids(&place, "actor"), workers);
    // The evaluator that was evaluating when its learner died may not be gone yet.
    running.until("one evaluator", |_| ids(&place, "evaluator").len() == 1);
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    for file in ["metrics.jsonl", "evaluations.jsonl"] {
        let steps = env_steps(&rows(&run, file));
        assert!(steps.is_sorted_by(|a, b| a < b), "{file}: {steps:?}");
    }
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(last["learner_restarts"], 2, "{last}");
    let mut refused = last["rejected"].as_object().unwrap().clone();
    refused.remove("duplicate");
    assert!(refused.values().all(|count| count == 0), "{last}");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
}

/// Without a checkpoint, the next learner takes everything from the log.
#[test]
fn at_delivery_level_log_a_killed_learner_loses_nothing() {
    let place = Workplace::new();
    let run = place.path("run");
    let keys = ["delivery.level=log", "checkpoint.interval_steps=1000000"];
    let keys: Vec<&str> = keys.into_iter().flat_map(|key| ["--set", key]).collect();
    let mut running = training(&place, &run, &keys);
    let reached = env_steps_of(&run).unwrap();
    replace_learner(&place, &run, &mut running, 1);
    running.until_said("segments read from the segment log");
    replace_learner(&place, &run, &mut running, 2);
    running.until("counts of the workers", |_| {
        let last = rows(&run, "metrics.jsonl").pop();
        last.is_some_and(|last| last["delivery"]["acked"].as_u64() > Some(0))
    });
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!((&last["lost"], &last["learner_restarts"]), (&0.into(), &2.into()), "{last}");
    assert!(last["env_steps"].as_u64().unwrap() > reached, "{last}");
}

#[test]
fn a_learner_killed_once_too_often_ends_the_run_with_its_log_and_advice() {
    let place = Workplace::new();
    let run = place.path("run");
    let running = training(&place, &run, &["--set", "supervision.learner_restarts_max=0"]);
    place.process("learner").signal(Signal::KILL);
    let reached = env_steps_of(&run).unwrap();
    running
        .wait()
        .with_status(1)
        .with_event(&json!({ "event": "finished", "outcome": "failed" }))
        .saying("error: learner died: signal 9")
        .saying("learner.log")
        .saying("dmprl resume");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
    resume_and_check_curve(&place, &run, reached);
}
