//! Workers that join a running run, and leave it.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::chown;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Instant;

use dmprl_tests::program::{
    PATIENCE, Process, Running, Workplace, env_steps_of, rows, shared_memory_of, until,
};
use dmprl_tests::skipped::skipped;
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::{ENDLESS, train};

/// Starts a run with one worker of its own and `places` for joining workers.
fn training(place: &Workplace, run: &str, places: &str, more: &[&str]) -> Running {
    let places = format!("actors.joined_max={places}");
    let own = ["--steps", ENDLESS, "--workers", "1", "--events", "json", "--set", &places];
    let more = [&own[..], more].concat();
    let mut running = place.start(&train("reacher", run, &more));
    running.until_steps(run, 1_000);
    running
}

/// The event of a joined worker that died or hung.
fn lost() -> Value {
    json!({ "event": "left", "process": "actor-1", "announced": false, "workers": 1 })
}

fn join(place: &Workplace, run: &str) -> Running {
    let mut joined = place.start(&["actor", "--join", run]);
    joined.until_said("joined run as actor-1: 2 workers");
    joined
}

/// Waits until the learner has learned from the joined worker: it knows the progress of its newest
/// incarnation.
fn until_learned_from(running: &mut Running, run: &str, incarnation: u64) {
    running.until("a checkpoint with segments of the worker that joined", |_| {
        let mark = &newest_state(run)["settled"][1];
        mark["incarnation"] == incarnation && mark["sequence"].as_u64() > Some(10)
    });
}

/// Returns the newest checkpoint's; null if there is none.
fn newest_state(run: &str) -> Value {
    let folder = fs::read_dir(Path::new(run).join("checkpoints")).unwrap();
    let states = folder.flatten().map(|entry| entry.path().join("state.json"));
    let newest = states.filter(|path| path.exists()).max();
    let text = newest.and_then(|path| fs::read_to_string(path).ok());
    // One that is removed just now is no longer the newest.
    text.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default()
}

fn end(place: &Workplace, run: &str, running: Running) {
    running.signal(Signal::INT);
    running.wait().with_status(130);
    let last = rows(run, "metrics.jsonl").pop().unwrap();
    let mut refused = last["rejected"].as_object().unwrap().clone();
    refused.remove("duplicate");
    assert!(refused.values().all(|count| count == 0), "{last}");
    place.until_no_process();
    assert_eq!(shared_memory_of(run), Vec::<PathBuf>::new());
}

#[test]
fn a_worker_joins_is_learned_from_and_makes_room_when_it_leaves_or_dies() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, "1", &[]);
    let joined = join(&place, &run);
    running.until_event(&json!({ "event": "joined", "process": "actor-1", "workers": 2 }));
    until_learned_from(&mut running, &run, 0);
    running.until("a line that counts both", |_| {
        rows(&run, "metrics.jsonl").pop().is_some_and(|last| last["workers"] == 2)
    });
    let refused = place.run(&["actor", "--join", &run]).with_status(1);
    refused.saying("1 of 1 places").saying("actors.joined_max");

    joined.signal_group(Signal::INT);
    let said = joined.wait().with_status(130).saying("left the run").said;
    let counts = said.split("left the run: ").nth(1).unwrap();
    let (acknowledged, rest) = counts.split_once(" of ").unwrap();
    assert_eq!(Some(acknowledged), rest.split(' ').next(), "all of them: {said}");
    let left = json!({ "event": "left", "process": "actor-1", "announced": true, "workers": 1 });
    running.until_event(&left);

    // The next one is killed, and the one after it gets its place too.
    let killed = join(&place, &run);
    until_learned_from(&mut running, &run, 1);
    killed.signal_group(Signal::KILL);
    running.until_event(&lost());
    let mut last = join(&place, &run);
    until_learned_from(&mut running, &run, 2);
    last.until_said("segments sent");
    end(&place, &run, running);
    last.wait().with_status(0).saying("the run has ended");
}

#[test]
fn a_worker_that_has_joined_stays_when_the_learner_is_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, "1", &[]);
    let joined = join(&place, &run);
    until_learned_from(&mut running, &run, 0);
    let learner = processes(&place, "learner").pop().unwrap();
    let before = newest_state(&run)["settled"][1]["sequence"].as_u64().unwrap();
    learner.signal(Signal::KILL);
    running.until_event(&json!({ "event": "first_step", "after_restart": true }));
    running.until("more of its segments", |_| {
        newest_state(&run)["settled"][1]["sequence"].as_u64() > Some(before + 100)
    });
    joined.signal_group(Signal::INT);
    joined.wait().with_status(130).saying("left the run");
    end(&place, &run, running);
}

#[test]
fn a_worker_that_has_joined_and_is_stopped_loses_its_place() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = ["--set", "supervision.heartbeat_timeout_s=5"];
    let mut running = training(&place, &run, "1", &more);
    let joined = join(&place, &run);
    running.until_event(&json!({ "event": "joined", "process": "actor-1" }));
    joined.signal_group(Signal::STOP);
    running.until_event(&lost());
    assert_eq!(joined.wait().status.code(), None);
    let joined = join(&place, &run);
    until_learned_from(&mut running, &run, 1);
    running.signal(Signal::KILL);
    joined.wait().with_status(1).saying("the supervisor of run is gone");
    place.until_no_process();
}

fn processes(place: &Workplace, role: &str) -> Vec<Process> {
    place.processes().into_iter().filter(|process| process.role == role).collect()
}

/// Counts open files of supervisor and learner, and files in shared memory, by their names without
/// digits.
fn held(place: &Workplace, run: &str) -> BTreeMap<String, usize> {
    let mut names = Vec::new();
    for role in ["train", "learner"] {
        let processes = processes(place, role);
        assert!(!processes.is_empty(), "a process {role}");
        for process in processes {
            let folder = format!("/proc/{}/fd", process.id.as_raw_nonzero());
            let open = fs::read_dir(folder).into_iter().flatten().flatten();
            let targets = open.filter_map(|entry| fs::read_link(entry.path()).ok());
            names.extend(targets.map(|target| format!("{role} has open {}", target.display())));
        }
    }
    let mut folders = shared_memory_of(run);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            names.push(entry.path().display().to_string());
            if entry.path().is_dir() {
                folders.push(entry.path());
            }
        }
    }
    let mut counts = BTreeMap::new();
    for mut name in names {
        name.retain(|letter| !letter.is_ascii_digit());
        *counts.entry(name).or_default() += 1;
    }
    counts
}

#[test]
fn joining_and_leaving_all_the_time_leaks_nothing() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, "1", &[]);
    let mut before = None;
    for round in 0..10 {
        let mut joined = join(&place, &run);
        match round % 4 {
            // In the middle of its start, its work, or its farewell.
            0 => joined.signal_group(Signal::KILL),
            1 => {
                joined.until_said("segments sent");
                joined.signal_group(Signal::KILL);
            }
            2 => {
                joined.until_said("segments sent");
                joined.signal_group(Signal::INT);
                joined.signal_group(Signal::KILL);
            }
            _ => {
                joined.signal_group(Signal::INT);
            }
        }
        joined.wait();
        let gone = |running: &Running| {
            running.events().iter().filter(|event| event["event"] == "left").count() == round + 1
        };
        running.until("its end is noticed", gone);
        if before.is_none() {
            until_learned_from_own(&mut running, &run);
            // Which stays open from the first line of metrics. The folder exists a moment earlier.
            let events = Path::new(&run).join("tensorboard");
            running.until("its event file", |_| {
                fs::read_dir(&events).is_ok_and(|mut entries| entries.next().is_some())
            });
            before = Some(held(&place, &run));
        }
    }
    let before = before.unwrap();
    let more = || {
        let mut after = held(&place, &run);
        after.retain(|name, count| *count > before.get(name).copied().unwrap_or(0));
        after
    };
    let deadline = Instant::now() + PATIENCE;
    let mut left = more();
    // Both also open some files for a moment.
    while !left.is_empty() {
        assert!(Instant::now() < deadline, "left behind: {left:#?}");
        left = more();
    }
    end(&place, &run, running);
}

/// The run continues, and the files of a dead worker are removed.
fn until_learned_from_own(running: &mut Running, run: &str) {
    let steps = env_steps_of(run).unwrap_or(0);
    running.until_steps(run, steps + 2_000);
}

#[test]
fn a_run_that_cannot_take_a_worker_in_says_why() {
    let place = Workplace::new();
    let run = place.path("run");
    let refused = |run: &str, status: i32, words: &str| {
        place.run(&["actor", "--join", run]).with_status(status).saying(words);
    };
    refused(&run, 2, "there is no run directory");
    place.run(&train("reacher", &run, &["--steps", "500"])).with_status(0);
    refused(&run, 1, "is not training on this machine");
    if rustix::process::geteuid().is_root() {
        chown(&run, Some(65_534), None).unwrap();
        refused(&run, 2, "belongs to user 65534");
    } else {
        let what = "joining a run of another user";
        skipped("TEST_ROOT_REQUIRED", what, "run the tests as root");
    }
    let alone = place.path("alone");
    let more = ["--steps", "100", "--set", "actors.joined_max=0"];
    place.run(&train("reacher", &alone, &more)).with_status(0);
    refused(&alone, 2, "its actors.joined_max is 0");
    let deterministic = place.path("deterministic");
    let more = ["--steps", "100", "--deterministic"];
    place.run(&train("reacher", &deterministic, &more)).with_status(0);
    refused(&deterministic, 2, "is deterministic");
}

/// Only processes of this user reach the socket, but they may have another version, or not be
/// workers at all.
#[test]
fn a_run_answers_strangers_and_goes_on() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = training(&place, &run, "1", &[]);
    let [domain] = &shared_memory_of(&run)[..] else { panic!("one domain") };
    let knock = || BufReader::new(UnixStream::connect(domain.join("join.sock")).unwrap());
    let silent: Vec<_> = (0..20).map(|_| knock()).collect();
    let mut nonsense = Vec::new();
    for line in ["{}\n", "nonsense\n", "\n", &"x".repeat(100_000)] {
        let mut stream = knock();
        // It may be rejected before it has sent everything.
        let _ = stream.get_mut().write_all(line.as_bytes());
        nonsense.push(stream);
    }
    drop(silent);
    let mut older = knock();
    let mut greeting = String::new();
    older.read_line(&mut greeting).unwrap();
    assert!(greeting.contains(r#""version":""#), "{greeting}");
    let request = r#"{"speaks":{"version":"0.0.0","control":0}}"#;
    writeln!(older.get_mut(), "{request}").unwrap();
    let mut answer = String::new();
    older.read_line(&mut answer).unwrap();
    assert!(answer.contains("got dmprl 0.0.0 (protocol 0)"), "{answer}");
    drop(nonsense);
    let joined = join(&place, &run);
    until_learned_from(&mut running, &run, 0);
    until("both live", || processes(&place, "actor").len() == 2);
    joined.signal_group(Signal::INT);
    joined.wait().with_status(130);
    end(&place, &run, running);
}
