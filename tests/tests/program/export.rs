//! `dmprl export`: a policy as one file that acts without its run.

use std::fs;
use std::path::Path;

use dmprl_runtime::PolicyRuntime;
use dmprl_shared::policy::Hold;
use dmprl_shared::policy_file;
use dmprl_tests::program::Workplace;
use serde_json::json;

use crate::{ENDLESS, train};

#[test]
fn a_runs_policy_leaves_as_one_file() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1500"])).with_status(0);

    let json = place.run(&["export", &run, "--policy", "latest", "--json"]).with_status(0).json();
    let own = place.path("run/reacher.safetensors");
    assert_eq!(
        (json["path"].as_str(), json["format"].as_str()),
        (Some(&*own), Some("safetensors"))
    );
    assert_eq!((&json["segment_steps"], &json["action_len"]), (&5.into(), &2.into()));
    let opened = policy_file::open(Path::new(&own)).unwrap();
    assert_eq!(json["policy_version"], opened.snapshot.version);
    let origin = opened.origin.unwrap();
    assert_eq!(
        (origin.task.as_str(), origin.return_mean),
        ("reacher", json["return_mean"].as_f64())
    );

    assert_eq!((opened.hold, &json["hold"]), (None, &json!(null)), "none is assumed");

    // For a robot, the export states the hold.
    let held = place.path("held.safetensors");
    let export =
        |hold: &str| place.run(&["export", &run, "--hold", hold, "--output", &held, "--json"]);
    for hold in [Hold::ZeroTorque, Hold::Position { values: vec![-0.5, 1.0] }] {
        let json = export(&hold.to_string()).with_status(0).json();
        assert_eq!(json["hold"], hold.to_string());
        assert_eq!(policy_file::open(Path::new(&held)).unwrap().hold, Some(hold));
    }
    fs::remove_file(&held).unwrap();
    for (hold, words) in [
        ("still", "zero-velocity"),
        ("position=0", "has 1 values, expected 2"),
        ("position=0,9", "expected -1 to 1"),
    ] {
        export(hold).with_status(2).saying(words);
    }
    assert!(!Path::new(&held).exists());

    // The file moves without the run, and can start another run.
    let moved = place.path("elsewhere.safetensors");
    fs::rename(&own, &moved).unwrap();
    let mut policy = PolicyRuntime::load(Path::new(&moved)).unwrap();
    assert_eq!(policy.segment(&[0.1; 10]).unwrap().len(), 10);
    let warm = ["--steps", "600", "--init-from", &moved];
    place.run(&train("reacher", &place.path("warm"), &warm)).with_status(0);

    // As in --help: a name in an existing folder.
    let onnx = place.path("reacher.onnx");
    let arguments = ["export", "run", "--format", "onnx", "--output", "reacher.onnx"];
    let said = place.run(&[&arguments[..], &["--hold", "zero-torque"]].concat()).with_status(0);
    assert!(said.printed.contains("reacher.onnx"), "{}", said.printed);
    let bytes = fs::read(&onnx).unwrap();
    for name in ["observation", "zero-torque"] {
        assert!(bytes.windows(name.len()).any(|part| part == name.as_bytes()), "no {name}");
    }
}

#[test]
fn what_cannot_be_exported_is_told_and_leaves_no_file() {
    let place = Workplace::new();
    place.run(&["export", "nowhere"]).with_status(2).saying("nowhere");
    let run = place.path("run");
    let more = ["--steps", ENDLESS, "--events", "json"];
    let mut training = place.start(&train("reacher", &run, &more));
    training.until_event(&json!({ "event": "started" }));
    training.signal_group(rustix::process::Signal::INT);
    training.wait();
    place.run(&["export", &run]).with_status(2).saying("no evaluation yet");
    let output = place.path("policy.onnx");
    place
        .run(&["export", &run, "--format", "safetensors", "--output", &output])
        .with_status(2)
        .saying("has the extension of the other format");
    assert!(!Path::new(&output).exists());
    let trained = place.path("trained");
    place.run(&train("reacher", &trained, &["--steps", "1000"])).with_status(0);
    let before = fs::read_dir(place.path("")).unwrap().count();
    for (output, words) in
        [("/dev/null", "not a regular file"), ("no/such/p.onnx", "does not exist")]
    {
        place.run(&["export", &trained, "--output", output]).with_status(2).saying(words);
    }
    assert_eq!(fs::read_dir(place.path("")).unwrap().count(), before, "nothing is left");
}
