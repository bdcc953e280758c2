//! Runs with workers on other hosts, which are all this host: real processes and real crashes.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use dmprl_tests::program::{
    Running, Workplace, json_file, process_naming, processes_naming, rows, shared_memory_of,
};
use rustix::process::Signal;

use crate::{ENDLESS, train};

/// Returns an unused endpoint on loopback.
fn endpoint() -> String {
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tls/{}", free.local_addr().unwrap())
}

/// Starts a run that accepts workers of other hosts.
fn learner(place: &Workplace, run: &str, endpoint: &str, more: &[&str]) -> Running {
    learner_of("reacher", place, run, endpoint, more)
}

fn learner_of(task: &str, place: &Workplace, run: &str, endpoint: &str, more: &[&str]) -> Running {
    let listen = format!("bridge.listen=[\"{endpoint}\"]");
    let open = ["--workers", "1", "--set", &listen, "--set", "bridge.workers_max=2"];
    let more = [&open[..], &["--set", "delivery.level=log"], more].concat();
    let mut running = place.start(&train(task, run, &more));
    running.until("a gateway", |running| {
        Path::new(run).join("bridge.token").is_file()
            && running.said().contains("first environment step")
    });
    running
}

fn bridge(place: &Workplace, run: &str, endpoint: &str, name: &str) -> Running {
    bridge_with(place, run, endpoint, name, &[])
}

fn bridge_with(place: &Workplace, run: &str, endpoint: &str, name: &str, more: &[&str]) -> Running {
    let token = format!("{run}/bridge.token");
    let (host, connect) = (place.path(name), ["--connect", endpoint, "--token-file", &token]);
    let own = ["--workers", "1", "--name", name, "--run-dir", &host];
    place.start(&[&["bridge"], &connect[..], &own, more].concat())
}

fn last(run: &str) -> serde_json::Value {
    rows(run, "metrics.jsonl").pop().unwrap_or_default()
}

/// Number of segments of the other host's worker in the newest checkpoint.
fn learned(run: &str, worker: usize) -> u64 {
    settled(run, worker, "sequence")
}

/// Incarnation of the worker that sent them.
fn incarnation(run: &str, worker: usize) -> u64 {
    settled(run, worker, "incarnation")
}

fn settled(run: &str, worker: usize, what: &str) -> u64 {
    let state = json_file(run, "checkpoints/latest/state.json");
    state["settled"][worker][what].as_u64().unwrap_or(0)
}

/// Index of the other host's worker: after the run's own, and the four that may join.
const REMOTE: usize = 5;

#[test]
fn another_hosts_worker_is_learned_from_whoever_dies_and_nothing_is_lost() {
    let place = Workplace::new();
    let (run, endpoint) = (place.path("run"), endpoint());
    let mut training = learner(&place, &run, &endpoint, &["--steps", ENDLESS]);
    let mut host = bridge(&place, &run, &endpoint, "far");
    training.until_said("host far takes part: 1 worker");
    training.until("a line that counts both workers", |_| last(&run)["workers"] == 2);
    let mut before = 0;
    for (who, role) in [("far", "relay"), ("run", "gateway"), ("run", "learner")] {
        process_naming(&place.path(who), role).signal(Signal::KILL);
        training.until("segments of the other host after that", |_| learned(&run, REMOTE) > before);
        // Beyond the segments that were in transit.
        before = learned(&run, REMOTE) + 20;
        training.until("more of them", |_| learned(&run, REMOTE) > before);
    }
    let first = incarnation(&run, REMOTE);
    process_naming(&place.path("far"), "actor").signal(Signal::KILL);
    training.until("segments of its next start", |_| incarnation(&run, REMOTE) > first);
    host.until_said("restart 1 of");
    // Kills the whole host at once, without a farewell. Started again, it gets its places back.
    let first = incarnation(&run, REMOTE);
    host.signal_group(Signal::KILL);
    let mut host = bridge(&place, &run, &endpoint, "far");
    host.until("segments of the next bridge", |_| incarnation(&run, REMOTE) >> 16 > first >> 16);
    training.until("the host in the table of processes", |_| {
        let table = json_file(&run, "processes.json");
        let rows = table["processes"].as_array().cloned().unwrap_or_default();
        rows.iter().any(|row| row["name"] == "host far")
    });
    // The host leaves; the run continues.
    host.signal_group(Signal::INT);
    host.wait().with_status(130).saying("left the run");
    training.until_said("host far has left");
    training.until("a line without it", |_| last(&run)["workers"] == 1);
    training.signal_group(Signal::INT);
    training.wait().with_status(130).saying("checkpoint written");
    assert_eq!(last(&run)["lost"], 0, "{}", last(&run));
    place.until_no_process();
    for folder in ["run", "far"] {
        assert_eq!(shared_memory_of(&place.path(folder)), Vec::<PathBuf>::new());
    }
}

#[test]
fn hosts_wait_for_a_run_that_was_stopped_and_end_with_one_that_is_over() {
    let place = Workplace::new();
    let (run, endpoint) = (place.path("run"), endpoint());
    // The bridge starts before the run.
    let mut early = {
        let token = place.path("early.token");
        fs::write(&token, "a secret that was made beforehand\n").unwrap();
        fs::set_permissions(&token, fs::Permissions::from_mode(0o600)).unwrap();
        let host = place.path("early");
        let connect = ["--connect", &endpoint, "--token-file", &token, "--name", "early"];
        place.start(&[&["bridge"], &connect[..], &["--workers", "1", "--run-dir", &host]].concat())
    };
    early.until_said("no learner's host answers");
    let token = format!("bridge.token_file={}", place.path("early.token"));
    let listen = format!("bridge.listen=[\"{endpoint}\"]");
    let more = ["--workers", "1", "--set", &listen, "--set", &token, "--steps", ENDLESS];
    let more = [&more[..], &["--max-minutes", "1"]].concat();
    let mut training = place.start(&train("reacher", &run, &more));
    training.until("segments of the other host", |_| learned(&run, REMOTE) > 10);
    training.signal_group(Signal::INT);
    training.wait().with_status(130);
    early.until_said("workers wait");
    let before = learned(&run, REMOTE);
    let mut resumed = place.start(&["resume", &run]);
    resumed.until_said("host early is back");
    resumed.until("more of its worker's segments", |_| learned(&run, REMOTE) > before);
    resumed.wait().with_status(0);
    early.wait().with_status(0).saying("the run has ended");
    assert_eq!(last(&run)["lost"], 0, "{}", last(&run));
    place.until_no_process();
}

#[test]
fn a_host_with_a_wrong_token_or_too_many_workers_is_told_what_to_do() {
    let place = Workplace::new();
    let (run, endpoint) = (place.path("run"), endpoint());
    let training = learner(&place, &run, &endpoint, &["--steps", ENDLESS]);
    let wrong = place.path("wrong");
    fs::write(&wrong, "not the secret of this run\n").unwrap();
    let with = |token: &str, workers: &str| {
        let connect = ["bridge", "--connect", &endpoint, "--token-file", token];
        place.run(&[&connect[..], &["--workers", workers]].concat()).with_status(2)
    };
    with(&wrong, "1").saying("chmod 600");
    fs::set_permissions(&wrong, fs::Permissions::from_mode(0o600)).unwrap();
    let connect = ["bridge", "--connect", &endpoint, "--token-file", &wrong];
    place.start(&connect).until_said("no learner's host with this token answers");
    with(&format!("{run}/bridge.token"), "3").saying("bridge.workers_max");
    with(&place.path("none"), "1").saying("copy bridge.token of the run's directory");
    drop(training);
    // An address in use is reported at once, and ends the run.
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let listen = format!("bridge.listen=[\"tls/{}\"]", taken.local_addr().unwrap());
    let second = place.path("second");
    let more = ["--workers", "1", "--set", &listen, "--steps", ENDLESS];
    place.run(&train("reacher", &second, &more)).with_status(1).saying("cannot listen at");
}

#[test]
fn an_endpoint_that_others_could_read_needs_a_flag() {
    let place = Workplace::new();
    let token = place.path("token");
    fs::write(&token, "a secret of some length\n").unwrap();
    fs::set_permissions(&token, fs::Permissions::from_mode(0o600)).unwrap();
    let connect = |endpoint: &str| {
        place.run(&["bridge", "--connect", endpoint, "--token-file", &token]).with_status(2)
    };
    connect("10.0.0.1").saying("expected tls/ADDRESS:PORT");
    connect("tcp/10.0.0.1:7447").saying("--allow-plain").saying("tls/10.0.0.1:7447");
    let (run, listen) = (place.path("run"), "bridge.listen=[\"tcp/0.0.0.0:7447\"]");
    let refused = place.run(&train("reacher", &run, &["--set", listen])).with_status(2);
    refused.saying("bridge.allow_plain").saying("tls/0.0.0.0:7447");
    assert!(!Path::new(&run).exists());
}

/// The module's directory exists on both hosts, and the learner's configuration names it.
#[test]
fn a_host_imports_only_what_its_own_user_named() {
    let place = Workplace::new();
    let (run, endpoint) = (place.path("run"), endpoint());
    fs::write(place.path("held.py"), HELD).unwrap();
    // A host that refuses keeps its place for a minute.
    let more = ["--python-path", &place.path(""), "--set", "bridge.workers_max=4"];
    let more = [&more[..], &["--envs-per-worker", "1", "--steps", ENDLESS]].concat();
    let _training = learner_of("held:Held-v0", &place, &run, &endpoint, &more);
    let (token, far) = (format!("{run}/bridge.token"), place.path("far"));
    let asks = ["bridge", "--connect", &endpoint, "--token-file", &token, "--workers", "1"];
    place.run(&asks).with_status(2).saying("--task 'held:Held-v0'");
    let other = [&asks[..], &["--task", "other:Other-v0"]].concat();
    place.run(&other).with_status(2).saying("held:Held-v0");
    // Named, but without its directory: its worker does not find it.
    let mut host = bridge_with(&place, &run, &endpoint, "far", &["--task", "held:Held-v0"]);
    host.until_said("no module 'held'");
    let config = fs::read_to_string(format!("{far}/config.toml")).unwrap();
    let config: toml::Table = config.parse().unwrap();
    assert_eq!(config["task"]["python_path"], toml::Value::Array(Vec::new()));
}

/// Each step blocks while `hold` exists, and reports its number within its process.
const HELD: &str = "
import os
import pathlib
import time

import gymnasium
import numpy as np
from gymnasium import spaces

HERE = pathlib.Path(__file__).parent


class Held(gymnasium.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, render_mode=None):
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(size=2), {}

    def step(self, action):
        self.steps += 1
        time.sleep(0.002)
        if (HERE / 'hold').exists() and self.steps % 5 == 3:
            told = HERE / f'writing-{os.getpid()}'
            told.write_text(str(self.steps))
            told.rename(HERE / f'held-{os.getpid()}')
            while (HERE / 'hold').exists():
                time.sleep(0.01)
        return self.np_random.uniform(size=2), float(action[0]), False, False, {}


gymnasium.register('Held-v0', Held, max_episode_steps=50)
";

#[test]
fn a_host_that_leaves_hands_over_the_segment_that_its_worker_was_in() {
    let place = Workplace::new();
    let (run, endpoint) = (place.path("run"), endpoint());
    fs::write(place.path("held.py"), HELD).unwrap();
    let more = ["--python-path", &place.path(""), "--envs-per-worker", "1", "--steps", ENDLESS];
    let mut training = learner_of("held:Held-v0", &place, &run, &endpoint, &more);
    let named = ["--task", "held:Held-v0", "--python-path", &place.path("")];
    let mut host = bridge_with(&place, &run, &endpoint, "far", &named);
    training.until_said("host far takes part: 1 worker");
    let far = place.path("far");
    let worker = |process: &dmprl_tests::program::Process| process.role == "actor";
    host.until("a worker of the host", |_| processes_naming(&far).iter().any(worker));
    let id = processes_naming(&far).into_iter().find(worker).unwrap().id;
    training.until("a line that counts both workers", |_| last(&run)["workers"] == 2);
    fs::write(place.path("hold"), "").unwrap();
    let held = place.path(&format!("held-{id}"));
    host.until("the worker in mid-segment", |_| Path::new(&held).is_file());
    let steps: u64 = fs::read_to_string(&held).unwrap().parse().unwrap();
    host.signal_group(Signal::INT);
    host.until_said("delivering the workers' segments");
    fs::remove_file(place.path("hold")).unwrap();
    host.wait().with_status(130).saying("left the run");
    training.until_said("host far has left");
    training.signal_group(Signal::INT);
    training.wait().with_status(130).saying("checkpoint written");
    assert!(learned(&run, REMOTE) > steps / 5, "{} after {steps} steps", learned(&run, REMOTE));
    assert_eq!(last(&run)["lost"], 0, "{}", last(&run));
}
