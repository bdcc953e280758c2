//! `dmprl bench scale` with few synthetic workers.

use dmprl_tests::program::{Running, Workplace, processes_naming, until};
use rustix::process::{Pid, Signal};

use super::{SMALL, assert_no_shared_memory, assert_no_temporary_files, assert_positive, start};

fn bench(place: &Workplace, more: &[&str]) -> Running {
    let few = ["scale", "--synthetic-workers", "8", "--feeders", "2", "--envs-per-worker", "2"];
    let short = ["--cost-seconds", "0.2", "--check-seconds", "0.2"];
    // A small replay fills at once.
    let replay = ["--set", "replay.capacity_steps=5000"];
    start(place, &[&few[..], &short, &SMALL, &replay, more].concat())
}

fn feeders(benchmark: Pid) -> usize {
    let processes = processes_naming(&format!("-{}", benchmark.as_raw_nonzero()));
    processes.iter().filter(|process| process.role == "segment-feeder").count()
}

fn assert_nothing_left(place: &Workplace, benchmark: Pid) {
    until("no feeder", || feeders(benchmark) == 0);
    place.assert_no_process();
    assert_no_shared_memory(benchmark);
    assert_no_temporary_files(place);
}

#[test]
fn ingest_loses_nothing_the_model_has_its_rows_and_a_real_system_stands_beside_it() {
    let place = Workplace::new();
    let running = bench(&place, &["--seconds", "0.2", "--check-workers", "1", "--json"]);
    let id = running.id();
    let json = running.wait().with_status(0).json();
    for key in ["segments_per_s", "jain_index", "rss_start_mb", "rss_end_mb", "received"] {
        assert_positive(&json, key);
    }
    assert_eq!((&json["segment_bytes"], &json["workers"]), (&1_024.into(), &8.into()));
    for fault in ["lost", "duplicate", "rejected"] {
        assert_eq!(json[fault], 0, "{fault}: {json}");
    }
    // Not tested: fairness on a loaded machine.
    assert!(json["share_min"].as_f64() <= Some(1.0) && json["share_max"].as_f64() >= Some(1.0));
    for cost in ["worker_us", "insert_us", "ingest_us", "update_us", "update_cpu_us"] {
        assert_positive(&json["costs"], cost);
    }
    let rows = json["model"].as_array().unwrap();
    let workers: Vec<_> = rows.iter().map(|row| row["workers"].as_u64().unwrap()).collect();
    assert_eq!(workers, [16, 32, 64, 128, 256, 512, 1_024]);
    for row in rows {
        assert_positive(row, "steps_per_s");
        assert!(row["bottleneck"].is_string() && row["hosts"].as_u64() > Some(1), "{row}");
        assert!(row["learner_utilisation"].as_f64() <= Some(1.0 + 1e-9), "{row}");
    }
    assert!(json["first_bottleneck"]["name"].is_string(), "{json}");
    let checks = json["check"].as_array().unwrap();
    assert_eq!(checks.len(), 1, "{json}");
    for key in ["predicted_steps_per_s", "measured_steps_per_s", "ratio", "cpu_ratio"] {
        assert_positive(&checks[0], key);
    }
    assert_nothing_left(&place, id);
}

#[test]
fn ctrl_c_ends_the_simulation_at_once_and_leaves_nothing() {
    let place = Workplace::new();
    let mut running = bench(&place, &["--seconds", "3600", "--json"]);
    let id = running.id();
    running.until_said("8 synthetic workers");
    until("feeders", || feeders(id) == 2);
    running.signal_group(Signal::INT);
    assert_eq!(running.wait().with_status(130).printed, "");
    assert_nothing_left(&place, id);
}

/// The next start removes the shared memory of killed processes.
#[test]
fn a_killed_benchmark_takes_its_feeders_with_it() {
    let place = Workplace::new();
    let running = bench(&place, &["--seconds", "3600"]);
    let id = running.id();
    until("feeders", || feeders(id) == 2);
    running.signal(Signal::KILL);
    until("no feeder", || feeders(id) == 0);
}

#[test]
fn a_feeder_that_dies_is_named_with_how_it_ended() {
    let place = Workplace::new();
    let running = bench(&place, &["--seconds", "3600"]);
    let id = running.id();
    until("feeders", || feeders(id) == 2);
    let processes = processes_naming(&format!("-{}", id.as_raw_nonzero()));
    let feeder = processes.iter().find(|process| process.role == "segment-feeder");
    feeder.unwrap().signal(Signal::KILL);
    running.wait().with_status(1).saying("feeder-").saying("died");
    assert_nothing_left(&place, id);
}

#[test]
fn more_learner_cores_than_there_are_cannot_be_measured() {
    let place = Workplace::new();
    bench(&place, &["--learner-cores", "1024"]).wait().with_status(2).saying("not extrapolated");
}

#[test]
fn an_algorithm_without_a_replay_has_no_such_costs() {
    let place = Workplace::new();
    let more = ["--algo", "ndp", "--set", "exploration.warm_up_steps=0"];
    bench(&place, &more).wait().with_status(2).saying("whole rollouts");
}
