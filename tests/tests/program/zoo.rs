//! Policies that come with the Python package.

use std::path::Path;

use dmprl_tests::program::Workplace;

#[test]
fn a_policy_of_the_package_is_evaluated_and_exported_like_one_of_a_run() {
    let place = Workplace::new();
    let evaluated = place.run(&["eval", "zoo:panda-reach", "--json"]).with_status(0).json();
    assert_eq!(evaluated["episodes"], 100);
    assert_eq!(evaluated["success_rate"], 1.0);
    let copied = place.path("runs/zoo-panda-reach");
    assert_eq!(evaluated["run"], std::fs::canonicalize(&copied).unwrap().display().to_string());
    place.run(&["export", "zoo:panda-reach"]).with_status(0);
    assert!(Path::new(&copied).join("panda-reach.safetensors").is_file());
    let refused = "zoo-panda-reach is a copy of zoo:panda-reach and has no checkpoint";
    place.run(&["resume", &copied]).with_status(2).saying(refused);
    place.run(&["eval", "zoo:panda-reach", "--episodes", "1"]).with_status(0);
    let run = place.path("run");
    let train = ["train", "panda-reach", "--run-dir", &run, "--steps", "400"];
    place.run(&[&train[..], &["--init-from", "zoo:panda-reach"]].concat()).with_status(0);
}

#[test]
fn an_unknown_policy_of_the_package_is_refused_with_the_known_ones() {
    let place = Workplace::new();
    let known = "there is no policy zoo:panda-dance; expected one of panda-";
    place.run(&["record", "zoo:panda-dance"]).with_status(2).saying(known);
    assert!(!Path::new(&place.path("runs")).exists());
}
