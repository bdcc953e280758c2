//! Environments that raise, hang or end their process: the run continues, and failed segments are
//! not learned from.

use std::fs;
use std::path::PathBuf;

use dmprl_learner::metrics::TIME_KEYS;
use dmprl_tests::program::{Finished, Workplace, env_steps, rows, shared_memory_of};
use dmprl_tests::tiny_envs_dir;
use serde_json::Value;

use crate::train;

const ENVS: u64 = 3;
/// Steps of an episode.
const EPISODE: u64 = 7;
/// Usable steps of a life of `tiny_envs:Faulty`: three episodes.
const LIFE: u64 = 21;

fn train_tiny(place: &Workplace, task: &str, more: &[&str]) -> (String, Finished) {
    let (run, folder, envs) = (place.path("run"), tiny_envs_dir(), ENVS.to_string());
    let common = ["--workers", "1", "--envs-per-worker", &envs];
    let more = [&common[..], &["--python-path", folder.to_str().unwrap()], more].concat();
    let finished = place.run(&train(&format!("tiny_envs:{task}-v0"), &run, &more));
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
    (run, finished)
}

fn log(place: &Workplace, name: &str) -> String {
    fs::read_to_string(place.path(&format!("run/logs/{name}.log"))).unwrap_or_default()
}

fn assert_sound(run: &str) -> Value {
    let last = rows(run, "metrics.jsonl").pop().unwrap();
    assert!(last["rejected"].as_object().unwrap().values().all(|count| count == 0), "{last}");
    assert_eq!(last["lost"], 0, "{last}");
    last
}

/// Three episodes of each life reach the learner; the fourth fails in its second step.
fn goes_on_and_counts(task: &str, words: &str) {
    let place = Workplace::new();
    let (run, finished) = train_tiny(&place, task, &["--steps", "4000"]);
    let finished = finished.with_status(0).saying(words).saying("actor-0.log");
    let last = assert_sound(&run);
    let steps = last["env_steps"].as_u64().unwrap();
    let episodes: u64 =
        rows(&run, "metrics.jsonl").iter().map(|row| row["episodes"].as_u64().unwrap()).sum();
    let unfinished = steps - episodes * EPISODE;
    assert!(unfinished <= ENVS * EPISODE, "{steps} steps in {episodes} episodes");

    // The evaluator's environments fail in their fourth evaluation, whose row exists all the same.
    let evaluated = env_steps(&rows(&run, "evaluations.jsonl"));
    assert_eq!(evaluated.iter().map(|steps| steps / 1000).collect::<Vec<_>>(), [1, 2, 3, 4]);
    let count = |name| log(&place, name).matches("environment failure: ").count() as u64;
    let (by_worker, by_evaluator) = (count("actor-0"), count("evaluator"));
    assert!(by_worker >= steps / LIFE - ENVS, "{by_worker} failures in {steps} steps");
    assert_eq!(by_evaluator, 4, "one in each episode of the evaluation");
    let counted = last["env_failures"].as_u64().unwrap();
    let total = by_worker + by_evaluator;
    // The learner's last line may lag behind the supervisor's count on a busy machine.
    let at_least = (steps / LIFE - ENVS) / 2;
    assert!((at_least..=total).contains(&counted), "{counted} of {total}, {at_least} at least");
    let summary = format!("failures   {total} in environments");
    assert!(finished.said.contains(&summary), "{summary}\n{}", finished.said);
    // At most one message for each doubling of the number.
    let told = finished.said.matches(": environment failure ").count() as u32;
    assert!((1..=total.ilog2() + 1).contains(&told), "{told} told\n{}", finished.said);
}

#[test]
fn a_run_whose_environment_raises_now_and_then_goes_on_and_counts() {
    goes_on_and_counts("FaultyRaise", "ValueError: the gripper fell off");
}

#[test]
fn a_run_whose_environment_observes_nan_now_and_then_goes_on_and_counts() {
    goes_on_and_counts("FaultyObservation", "observation[1] is nan");
}

#[test]
fn a_run_whose_environment_rewards_infinitely_now_and_then_goes_on_and_counts() {
    goes_on_and_counts("FaultyReward", "reward is inf");
}

#[test]
fn an_environment_that_always_fails_costs_its_worker_and_then_the_run() {
    let place = Workplace::new();
    let settings = ["--set", "actors.env_failures_max=2", "--set", "actors.restarts_max=1"];
    let (_, finished) = train_tiny(&place, "Hopeless", &settings);
    finished
        .with_status(1)
        .saying("environment 0 has failed 3 times without completing an episode")
        .saying("ValueError: the gripper fell off")
        .saying("restart 1 of 1")
        .saying("no worker is left");
}

/// The environment that fails leaves a mark, so the next life of its worker is sound.
fn survives(task: &str, words: &[&str]) -> (Workplace, String) {
    let place = Workplace::new();
    // A call may take longer than the heartbeat limit: the worker reports that it is in a call.
    let keys = ["actors.env_call_timeout_s=10", "supervision.heartbeat_timeout_s=5"];
    let more = ["--steps", "1500", "--set", keys[0], "--set", keys[1]];
    let (run, finished) = train_tiny(&place, task, &more);
    assert!(!finished.said.contains("no heartbeat"), "{}", finished.said);
    let mut finished = finished.with_status(0).saying("actor-0 died").saying("restart 1 of 5");
    for words in words {
        finished = finished.saying(words);
    }
    assert!(PathBuf::from(place.path("broken")).exists(), "nothing broke");
    assert!(assert_sound(&run)["env_steps"].as_u64() >= Some(1500));
    (place, run)
}

#[test]
fn a_worker_whose_environment_hangs_is_replaced_and_an_evaluator_says_so() {
    let words = ["an environment hangs: `step_segment`", "for 10.0 s", "exit status 75"];
    let (place, run) = survives("HangOnce", &words);
    fs::remove_file(place.path("broken")).unwrap();
    // Four episodes in each of its environments: a life ends in the fourth.
    place
        .run(&["eval", &run, "--episodes", "40"])
        .with_status(1)
        .saying("the evaluator died: exit status 75, an environment hung");
    place.assert_no_process();
}

/// In such a worker no other Python code runs, not even in another thread.
#[test]
fn a_worker_whose_environment_hangs_with_the_interpreters_lock_is_replaced() {
    survives("HangWithLockOnce", &["an environment hangs", "exit status 75"]);
}

#[test]
fn a_worker_whose_environment_crashes_the_process_is_replaced() {
    survives("SegfaultOnce", &["signal 11 (SIGSEGV)"]);
}

/// A forked child inherits the worker's memory, files and locks, and ends without its clean-up.
#[test]
fn an_environment_that_forks_takes_nothing_from_its_worker() {
    let place = Workplace::new();
    let (run, finished) = train_tiny(&place, "Forking", &["--steps", "2000"]);
    let finished = finished.with_status(0);
    assert!(!finished.said.contains("died"), "{}", finished.said);
    let last = assert_sound(&run);
    assert!(last["episodes"].as_u64() > Some(0) && last["env_failures"] == 0, "{last}");
}

#[test]
fn one_process_goes_on_after_failures_and_repeats_them_to_the_byte() {
    let repeated = || {
        let place = Workplace::new();
        // The fourth evaluation is the last, and the one in which its environments fail.
        let more = ["--deterministic", "--steps", "1500", "--set", "evaluation.interval_steps=400"];
        let (run, finished) = train_tiny(&place, "FaultyRaise", &more);
        finished.with_status(0).saying("learner: environment failure ").saying("failures   ");
        let told = log(&place, "learner").matches("environment failure: ").count() as u64;
        assert!(told >= 1500 / LIFE - ENVS, "{told} failures");
        assert_eq!(assert_sound(&run)["env_failures"].as_u64(), Some(told), "all of them");
        let mut rows = rows(&run, "metrics.jsonl");
        for row in &mut rows {
            TIME_KEYS.iter().for_each(|key| drop(row.as_object_mut().unwrap().remove(*key)));
        }
        rows
    };
    assert_eq!(repeated(), repeated());
}

/// The only process is not restarted. It reports why it ended, and a resume continues.
#[test]
fn one_process_whose_environment_hangs_ends_and_can_be_resumed() {
    let place = Workplace::new();
    let more = ["--deterministic", "--steps", "600", "--set", "actors.env_call_timeout_s=10"];
    let (run, finished) = train_tiny(&place, "HangOnce", &more);
    finished.with_status(1).saying("learner died: exit status 75, an environment hung");
    place.run(&["resume", &run]).with_status(0);
    assert_sound(&run);
}
