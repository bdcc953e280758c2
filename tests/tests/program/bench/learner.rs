//! `dmprl bench learner`. It needs no Python.

use dmprl_tests::program::{Running, Workplace};
use rustix::process::Signal;

use super::{assert_no_temporary_files, assert_positive, start};

fn bench(place: &Workplace, more: &[&str]) -> Running {
    let short = ["learner", "--seconds", "0.05", "--set", "policy.hidden=[16]"];
    let small = ["--set", "algorithm.critic_hidden=[16]", "--set", "algorithm.batch_size=32"];
    start(place, &[&short[..], &small, more].concat())
}

fn assert_nothing_left(place: &Workplace) {
    place.assert_no_process();
    assert_no_temporary_files(place);
}

#[test]
fn every_algorithm_with_every_policy_is_measured_beside_its_floor() {
    let place = Workplace::new();
    for algorithm in ["ddpg", "td3", "sac", "tqc"] {
        for policy in ["dmp", "mlp"] {
            let more = ["--task", "reacher", "--algo", algorithm, "--policy", policy];
            let more = [&more[..], &["--threads", "2", "--rounds", "2", "--json"]].concat();
            let json = bench(&place, &more).wait().with_status(0).json();
            for key in
                ["ms_per_update", "floor_ms", "ratio_to_floor", "updates_per_s", "peak_memory_mb"]
            {
                assert_positive(&json, key);
            }
            assert_eq!((&json["batch_size"], &json["threads"]), (&32.into(), &2.into()));
            assert_eq!((&json["algorithm"], &json["policy"]), (&algorithm.into(), &policy.into()));
            assert_eq!(json["rounds"]["ours"].as_array().unwrap().len(), 2, "{json}");
            assert!(json["peer_torch_ms"].is_null() && json.get("peer_jax_ms").is_some());
            let shares = &json["share_of_time"];
            for part in ["sample", "products", "optimiser"] {
                assert_positive(shares, part);
            }
        }
    }
    assert_nothing_left(&place);
}

/// A fake peer that speaks the protocol, so that the tests do not need the real ones.
#[test]
fn a_peer_is_asked_for_rounds_of_its_own_and_an_absent_one_says_why() {
    let place = Workplace::new();
    let interpreter = place.path("python");
    // $2 is the peer's name.
    let script = r#"#!/bin/sh
if [ "$2" = jax ]; then echo '{"absent": "no jax here"}'; exit; fi
[ -s "$4" ] && [ "$6" = 1 ] && echo '{"ready": "made up"}'
while read -r command seconds; do echo '{"updates": 4, "seconds": 2.0, "cpu_s": 1.0}'; done
"#;
    std::fs::write(&interpreter, script).unwrap();
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o700);
    std::fs::set_permissions(&interpreter, executable).unwrap();
    let peers = ["--peer", "torch", "--peer", "jax", "--peer-python", &interpreter];
    let more = ["--task", "pusher", "--threads", "1", "--rounds", "1", "--json"];
    let json = bench(&place, &[&more[..], &peers].concat()).wait().with_status(0).json();
    assert_eq!(json["peer_torch_ms"], 500.0, "{json}");
    assert_eq!(json["cpu_ms_per_update"]["torch"], 250.0, "{json}");
    assert_eq!(json["notes"]["torch"], "made up");
    assert!(json["peer_jax_ms"].is_null(), "{json}");
    assert_eq!(json["notes"]["jax"], "no jax here");
    assert_nothing_left(&place);
}

#[test]
fn a_task_whose_sizes_are_not_known_is_refused() {
    let place = Workplace::new();
    let finished = bench(&place, &["--task", "Pendulum-v1"]).wait().with_status(2);
    finished.saying("sizes").saying("reacher");
}

#[test]
fn an_algorithm_that_the_peers_do_not_have_is_refused() {
    let place = Workplace::new();
    let more = ["--task", "reacher", "--algo", "tqc", "--peer", "torch"];
    bench(&place, &more).wait().with_status(2).saying("--peer with --algo tqc");
}

/// The tests' program is built without the feature `cuda`.
#[test]
fn a_build_without_cuda_refuses_a_gpu_and_names_the_remedy() {
    let place = Workplace::new();
    for device in [&["--device", "cuda"], &["--set", "learner.device=cuda"]] {
        let more = [&["--task", "reacher"], &device[..]].concat();
        let finished = bench(&place, &more).wait().with_status(2);
        finished.saying("this build has no CUDA").saying("cargo build --release --features cuda");
    }
    assert_nothing_left(&place);
}

#[test]
fn ctrl_c_ends_it_and_leaves_nothing() {
    let place = Workplace::new();
    let mut running = bench(&place, &["--task", "reacher", "--rounds", "1000", "--json"]);
    running.until_said("round 2 of 1000");
    running.signal_group(Signal::INT);
    assert_eq!(running.wait().with_status(130).printed, "");
    assert_nothing_left(&place);
}
