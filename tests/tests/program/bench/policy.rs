//! `dmprl bench policy`: the time of a decision next to a robot.

use dmprl_tests::program::Workplace;

#[test]
fn a_decision_is_measured_beside_numpy() {
    let place = Workplace::new();
    let few = ["--calls", "20", "--rounds", "2", "--json"];
    let json = place.run(&[&["bench", "policy", "--task", "pusher"][..], &few].concat());
    let json = json.with_status(0).json();
    for latency in [&json["decision"], &json["action"], &json["peers"]["numpy"]["decision"]] {
        let us = ["p50_us", "p99_us", "max_us"].map(|name| latency[name].as_f64().unwrap());
        assert!(0.0 < us[0] && us.is_sorted(), "{json}");
    }
    assert_eq!(json["what"], "Pusher-v5 23-256-256-70");
    // The interpreter of .venv has no onnxruntime, which is reported and is not a failure.
    assert!(json["peers"]["onnx"].is_null(), "{json}");
    place.assert_no_process();
}

#[test]
fn what_is_no_policy_is_refused() {
    let place = Workplace::new();
    place.run(&["bench", "policy", "nowhere"]).with_status(2).saying("nowhere");
    place.run(&["bench", "policy", "--task", "Pendulum-v1"]).with_status(2).saying("pusher");
    place.run(&["bench", "policy"]).with_status(2);
    let set = ["bench", "policy", "mine", "--set", "dmp.alpha_y=3.0"];
    place.run(&set).with_status(2).saying("go with --task");
    std::fs::write(place.path("text"), "no policy").unwrap();
    place.run(&["bench", "policy", &place.path("text")]).with_status(1).saying("safetensors");
}
