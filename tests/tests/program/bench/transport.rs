//! `dmprl bench transport` with real processes.

use dmprl_tests::program::{Running, Workplace, processes_naming, until};
use rustix::process::{Pid, Signal};

use super::{assert_no_shared_memory, assert_no_temporary_files, assert_positive, start};

fn bench(place: &Workplace, more: &[&str]) -> Running {
    start(place, &[&["transport", "--seconds", "0.05"], more].concat())
}

/// Returns the processes of a benchmark. Each names the shared memory, which names the benchmark,
/// or its pipe, or the folder of its logs.
fn is_alone(place: &Workplace, benchmark: Pid) -> bool {
    let id = benchmark.as_raw_nonzero();
    let names = [format!("-{id}"), format!("/proc/{id}/fd/")];
    let its_worker = |text: &String| {
        processes_naming(text).iter().any(|process| process.role == "transport-worker")
    };
    place.processes().is_empty() && !names.iter().any(its_worker)
}

/// The sender of a Python peer checks twenty times a second whether its receiver is alive.
fn until_nothing_left(place: &Workplace, benchmark: Pid) {
    until("no process", || is_alone(place, benchmark));
    assert_no_shared_memory(benchmark);
    assert_no_temporary_files(place);
}

#[test]
fn nothing_is_lost_and_nothing_comes_twice_whatever_the_size() {
    let place = Workplace::new();
    let running = bench(&place, &["--workers", "2", "--rounds", "3", "--json"]);
    let id = running.id();
    let json = running.wait().with_status(0).json();
    assert_eq!(json["workers"], 2);
    // Not tested: its size on a loaded machine.
    assert!(json["blocked_cpu_fraction"].as_f64() >= Some(0.0), "{json}");
    let sizes = json["sizes"].as_array().unwrap();
    let bytes: Vec<_> = sizes.iter().map(|size| &size["segment_bytes"]).collect();
    assert_eq!(bytes, [1_024, 10_240]);
    for size in sizes {
        assert_positive(size, "segments_per_s");
        assert!(size["received"].as_u64() > Some(512), "{json}");
        for fault in ["lost", "duplicate", "rejected"] {
            assert_eq!(size[fault], 0, "{json}");
        }
        assert_eq!(size["rounds"].as_array().unwrap().len(), 3, "{json}");
        for peer in ["pipe", "unix_socket", "multiprocessing_queue"] {
            assert_positive(&size["peers"], peer);
            assert_positive(&size["to_peers"], peer);
        }
    }
    assert_eq!(json["peers"], sizes[0]["peers"]);
    // With pyzmq in .venv there is a figure, otherwise null and the reason.
    let zeromq = json["peers"].get("zeromq").unwrap();
    assert!(zeromq.as_f64() > Some(0.0) || zeromq.is_null(), "{json}");
    let note = json["notes"]["zeromq"].as_str().unwrap();
    assert!(zeromq.is_null() == note.contains("pyzmq is not installed"), "{note}");
    until_nothing_left(&place, id);
}

/// The receiver writes each segment to the log before it acknowledges it.
#[test]
fn at_level_log_nothing_is_lost_either_and_no_log_stays() {
    let place = Workplace::new();
    let running = bench(&place, &["--workers", "1", "--rounds", "2", "--level", "log", "--json"]);
    let id = running.id();
    let json = running.wait().with_status(0).json();
    assert_eq!(json["level"], "log");
    for size in json["sizes"].as_array().unwrap() {
        assert_positive(size, "segments_per_s");
        for fault in ["lost", "duplicate", "rejected"] {
            assert_eq!(size[fault], 0, "{json}");
        }
    }
    until_nothing_left(&place, id);
}

/// The remaining parts are measured.
#[test]
fn an_interpreter_that_is_none_makes_its_peers_absent_with_its_last_word() {
    let place = Workplace::new();
    let interpreter = place.path("no-python");
    std::fs::write(&interpreter, "#!/bin/sh\necho no python here >&2\nexit 3\n").unwrap();
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o700);
    std::fs::set_permissions(&interpreter, executable).unwrap();
    let more = ["--workers", "1", "--rounds", "1", "--peer-python", &interpreter];
    let finished = bench(&place, &more).wait().with_status(0);
    let printed = &finished.printed;
    for peer in ["multiprocessing_queue", "zeromq"] {
        let rows: Vec<_> = printed.lines().filter(|line| line.contains(peer)).collect();
        assert_eq!(rows.iter().filter(|row| row.ends_with("absent")).count(), 2, "{printed}");
        let said = rows.last().unwrap();
        assert!(said.contains("exit status 3, no python here"), "{printed}");
    }
    assert!(printed.contains(" 0 lost, 0 duplicate, 0 rejected"), "{printed}");
}

#[test]
fn ctrl_c_ends_it_at_once_and_leaves_nothing() {
    let place = Workplace::new();
    let mut running = bench(&place, &["--workers", "2", "--rounds", "1000", "--json"]);
    let id = running.id();
    running.until_said("round 2 of 1000");
    assert!(!is_alone(&place, id), "its processes are found");
    running.signal_group(Signal::INT);
    assert_eq!(running.wait().with_status(130).printed, "");
    until_nothing_left(&place, id);
}

/// The next start removes the shared memory of killed processes.
#[test]
fn a_killed_benchmark_takes_its_processes_with_it() {
    let place = Workplace::new();
    let mut running = bench(&place, &["--workers", "1", "--rounds", "1000"]);
    let id = running.id();
    running.until_said("round 2 of 1000");
    running.signal(Signal::KILL);
    until("no process", || is_alone(&place, id));
}

#[test]
fn a_worker_that_dies_is_named_with_how_it_ended() {
    let place = Workplace::new();
    let mut running = bench(&place, &["--workers", "1", "--rounds", "1000"]);
    let id = running.id();
    running.until_said("round 2 of 1000");
    let workers = processes_naming(&format!("-{}", id.as_raw_nonzero()));
    let ours = |text: &String| text == "--shared-memory";
    let worker = workers.iter().find(|process| process.command_line.iter().any(ours));
    worker.unwrap().signal(Signal::KILL);
    running.wait().with_status(1).saying("worker-0-").saying("died");
    until_nothing_left(&place, id);
}
