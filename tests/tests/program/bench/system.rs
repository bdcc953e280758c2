//! `dmprl bench system` with a real run.

use dmprl_tests::program::{Running, Workplace};
use rustix::process::Signal;

use super::{SMALL, assert_no_temporary_files, assert_positive, start};

fn bench(place: &Workplace, more: &[&str]) -> Running {
    let few = ["system", "--task", "reacher", "--envs-per-worker", "2"];
    let metrics = ["--set", "metrics.interval_steps=50"];
    start(place, &[&few[..], &SMALL, &metrics, more].concat())
}

/// The run's supervisor has its own session, so the benchmark waits for it.
fn assert_nothing_left(place: &Workplace) {
    place.assert_no_process();
    assert_no_temporary_files(place);
}

#[test]
fn a_whole_run_is_measured_after_its_warm_up_and_leaves_nothing() {
    let place = Workplace::new();
    let more = ["--workers", "2", "--seconds", "0.5", "--json"];
    let json = bench(&place, &more).wait().with_status(0).json();
    for key in ["env_steps_per_s", "updates_per_s", "samples_per_insert", "wall_s"] {
        assert_positive(&json, key);
    }
    assert!(json["wall_s"].as_f64() >= Some(0.5), "{json}");
    // Both kinds of lag are present, and no median exceeds its maximum.
    assert!(json["policy_lag_p50"].as_u64() <= json["policy_lag_max"].as_u64(), "{json}");
    assert!(json["policy_lag_max"].is_u64(), "{json}");
    assert!(json["excluded"]["env_steps"].as_u64() > Some(200), "{json}");
    // The pacing holds for any interval, up to the updates that may be pending at its ends.
    assert_eq!(json["updates_per_segment_asked"], 2.0);
    let measured = json["updates_per_segment"].as_f64().unwrap();
    assert!((0.5..4.0).contains(&measured), "{json}");
    assert_positive(&json["cpu_s"], "learner");
    assert_eq!((&json["lost"], &json["rejected"]), (&0.into(), &0.into()), "{json}");
    assert_eq!((&json["workers"], &json["envs_per_worker"]), (&2.into(), &2.into()));
    assert_nothing_left(&place);
}

#[test]
fn ctrl_c_ends_the_run_and_leaves_nothing() {
    let place = Workplace::new();
    let mut running = bench(&place, &["--seconds", "3600", "--json"]);
    running.until_said("measuring for 3600 s");
    running.signal_group(Signal::INT);
    assert_eq!(running.wait().with_status(130).printed, "");
    assert_nothing_left(&place);
}

#[test]
fn a_run_that_cannot_start_is_named_with_its_own_words() {
    let place = Workplace::new();
    let more = ["--set", "task.id=Reachr-v5"];
    bench(&place, &more).wait().with_status(1).saying("dmprl train exited").saying("Reachr");
    assert_nothing_left(&place);
}

#[test]
fn a_deterministic_run_has_no_system_to_measure() {
    let place = Workplace::new();
    let more = ["--set", "run.deterministic=true"];
    bench(&place, &more).wait().with_status(2).saying("one process");
}
