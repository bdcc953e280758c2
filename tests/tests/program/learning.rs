//! That a short run learns: the one test that no amount of right plumbing passes.

use dmprl_tests::program::{Workplace, rows};

#[test]
fn reacher_learns_in_eight_thousand_steps() {
    let place = Workplace::new();
    let run = place.path("run");
    let arguments = ["train", "reacher", "--deterministic", "--seed", "1", "--steps", "8000"];
    place.run(&[&arguments[..], &["--run-dir", &run]].concat()).with_status(0);
    let reached = rows(&run, "evaluations.jsonl").pop().unwrap()["return_mean"].as_f64().unwrap();
    assert!(reached >= -11.0, "{reached}");
}
