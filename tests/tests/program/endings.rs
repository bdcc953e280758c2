//! Runs that end by their own rules before they have all their steps.

use dmprl_tests::program::{Workplace, env_steps, rows, shared_memory_of};

use crate::{ENDLESS, train};

/// Runs without end but for `more`; the last evaluation must be of the last moment.
fn ends(more: &[&str], saying: &str) {
    let place = Workplace::new();
    let run = place.path("run");
    let more = [&["--steps", ENDLESS][..], more].concat();
    place.run(&train("reacher", &run, &more)).with_status(0).saying(saying);
    let last = |file| env_steps(&rows(&run, file)).last().copied().unwrap();
    assert_eq!(last("evaluations.jsonl"), last("metrics.jsonl"));
    let steps = env_steps(&rows(&run, "evaluations.jsonl"));
    assert!(steps.is_sorted_by(|a, b| a < b), "{steps:?}");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new());
}

#[test]
fn a_return_that_is_reached_ends_the_run_with_a_last_evaluation() {
    ends(&["--until-return", "-1000"], "the return has reached -1000");
}

#[test]
fn a_return_that_is_reached_ends_a_deterministic_run_too() {
    ends(&["--until-return", "-1000", "--deterministic"], "  return ");
}

#[test]
fn minutes_that_are_over_end_the_run_with_a_last_evaluation() {
    ends(&["--max-minutes", "0.05"], "run.max_minutes are over");
}
