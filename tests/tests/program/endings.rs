//! Runs that end by their own limits before they have all their steps.

use std::process::Command;

use dmprl_tests::program::{
    Workplace, env_steps, env_steps_of_checkpoint, executable, rows, shared_memory_of,
};
use rustix::process::Signal;

use crate::{ENDLESS, train};

/// Starts a run that only `more` limits, and checks that its last evaluation is of its last step.
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
    ends(&["--max-minutes", "0.05"], "run.max_minutes has elapsed");
}

/// Largest file that a run may write [blocks of 512 bytes]: just enough for the replay of about
/// 6,000 steps. The program sees a full disk, without a mount.
const FILE_BLOCKS_MAX: &str = "800";

fn train_on_a_full_disk(run: &str, more: &[&str]) -> Command {
    let mut command = Command::new("sh");
    let script = "trap '' XFSZ; ulimit -f $0; exec \"$@\"";
    command.args(["-c", script, FILE_BLOCKS_MAX]).arg(executable());
    command.args(train("reacher", run, more));
    command
}

#[test]
fn a_full_disk_costs_the_checkpoints_and_not_the_run() {
    let place = Workplace::new();
    let run = place.path("run");
    let finished = place
        .start_command(train_on_a_full_disk(&run, &["--steps", "9000"]))
        .wait()
        .with_status(0)
        .saying("no checkpoint could be written, training continues")
        .saying("the last checkpoint was not written");
    assert_eq!(finished.said.matches("no checkpoint could be written").count(), 1, "told once");
    assert_eq!(env_steps(&rows(&run, "evaluations.jsonl")).last(), Some(&9000));
    let kept = env_steps_of_checkpoint(&run).unwrap();
    assert!((4_000..9_000).contains(&kept), "{kept}");

    // After space is freed, from the previous checkpoint.
    place.run(&["resume", &run]).with_status(0);
    assert_eq!(env_steps_of_checkpoint(&run), Some(9000));
}

#[test]
fn ctrl_c_on_a_full_disk_does_not_claim_a_checkpoint() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start_command(train_on_a_full_disk(&run, &["--steps", ENDLESS]));
    running.until_said("no checkpoint could be written");
    running.signal_group(Signal::INT);
    let finished = running.wait().with_status(130).saying("the last checkpoint was not written");
    assert!(!finished.said.contains("checkpoint written"), "{}", finished.said);
    place.assert_no_process();
}

/// The evaluation takes minutes, during which a run in one process does nothing else.
#[test]
fn ctrl_c_during_a_long_evaluation_still_writes_the_checkpoint() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = ["--deterministic", "--steps", ENDLESS, "--set", "evaluation.episodes=10000"];
    let mut running = place.start(&train("reacher", &run, &more));
    let policies = std::path::Path::new(&run).join("policies");
    running.until("a policy to evaluate", |_| {
        std::fs::read_dir(&policies).is_ok_and(|mut files| files.next().is_some())
    });
    running.signal_group(Signal::INT);
    running.wait().with_status(130).saying("checkpoint written");
    assert!(rows(&run, "evaluations.jsonl").is_empty());
    place.assert_no_process();
}
