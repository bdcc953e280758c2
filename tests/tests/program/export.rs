//! `dmprl export`: a policy as one file that acts without its run.

use std::fs;
use std::path::Path;

use dmprl_shared::policy_file;
use dmprl_shared::runtime::PolicyRuntime;
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

    // The file moves without the run, and can start another run.
    let moved = place.path("elsewhere.safetensors");
    fs::rename(&own, &moved).unwrap();
    let mut policy = PolicyRuntime::load(Path::new(&moved)).unwrap();
    assert_eq!(policy.segment(&[0.1; 10]).unwrap().len(), 10);
    let warm = ["--steps", "600", "--init-from", &moved];
    place.run(&train("reacher", &place.path("warm"), &warm)).with_status(0);

    // As in --help: a name in an existing folder.
    let onnx = place.path("reacher.onnx");
    let said = place.run(&["export", "run", "--format", "onnx", "--output", "reacher.onnx"]);
    let said = said.with_status(0);
    assert!(said.printed.contains("reacher.onnx"), "{}", said.printed);
    assert!(fs::read(&onnx).unwrap().windows(11).any(|name| name == b"observation"));
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
