//! How evaluations and exported policies execute segments: `policy.execution`.

use std::fs;
use std::path::Path;

use dmprl_shared::config::Execution;
use dmprl_shared::policy_file;
use dmprl_tests::program::Workplace;

use crate::train;

#[test]
fn a_policy_blends_segments_unless_its_run_is_older_or_the_user_says_otherwise() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1500"])).with_status(0);
    let smoothness = |extra: &[&str]| {
        let arguments = [&["eval", &run, "--policy", "latest", "--json"], extra].concat();
        place.run(&arguments).with_status(0).json()["smoothness"].as_f64().unwrap()
    };
    let by_default = smoothness(&[]);
    let [ensemble, segment] = ["ensemble", "segment"]
        .map(|name| smoothness(&["--set", &format!("policy.execution={name}")]));
    assert_eq!(by_default, ensemble);
    assert!(ensemble < segment, "{ensemble} {segment}");

    let refused = ["eval", &run, "--set", "policy.execution=none"];
    place.run(&refused).with_status(2).saying("expected `segment` or `ensemble`");
    let refused = ["eval", &run, "--set", "policy.start=carry"];
    place.run(&refused).with_status(2).saying("policy.execution=NAME");

    // A file for a robot can execute the policy otherwise.
    let file = place.path("policy.safetensors");
    for (extra, expected) in
        [(&[][..], Execution::Ensemble), (&["--execution", "segment"], Execution::Segment)]
    {
        let export = [&["export", &run, "--output", &file], extra].concat();
        place.run(&export).with_status(0);
        let opened = policy_file::open(Path::new(&file)).unwrap();
        assert_eq!(opened.policy.description().policy.execution, expected);
    }

    // The configuration of a run from before the key.
    let path = place.path("run/config.toml");
    let text = fs::read_to_string(&path).unwrap();
    let older = text.replace("execution = \"ensemble\"\n", "");
    assert!(older.len() < text.len());
    fs::write(&path, older).unwrap();
    assert_eq!(smoothness(&[]), segment);
}
