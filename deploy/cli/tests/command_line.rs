//! Tests the command line: help, usage errors and exit statuses.
#![allow(clippy::unwrap_used)] // helpers of tests fail as tests do

use std::path::Path;
use std::process::{Command, Output};

use dmprl_run::{Manifest, RunDirectory};
use dmprl_shared::config::ExperimentConfig;

fn dmprl(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_dmprl")).args(arguments).output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Runs a command that must be rejected with status 2; returns its error message.
fn refused(arguments: &[&str]) -> String {
    let output = dmprl(arguments);
    let said = String::from_utf8(output.stderr.clone()).unwrap();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
    assert!(output.stdout.is_empty(), "standard output is for results");
    said
}

#[test]
fn every_command_has_help_with_examples() {
    let commands = ["train", "resume", "eval", "bench", "tasks", "doctor", "clean"];
    let more = ["learner", "actor", "evaluator", "bench rollout"];
    for command in commands.into_iter().chain(more) {
        let words: Vec<&str> = command.split(' ').chain(["--help"]).collect();
        let output = dmprl(&words);
        assert!(output.status.success());
        let help = stdout(&output);
        assert!(help.contains("EXAMPLES"), "{command}");
        assert!(help.contains(&format!("dmprl {command} ")), "{command}");
    }
}

#[test]
fn only_the_long_help_lists_the_roles() {
    let short = stdout(&dmprl(&["-h"]));
    let long = stdout(&dmprl(&["--help"]));
    assert!(short.contains("train") && !short.contains("\n  learner "), "{short}");
    assert!(long.contains("ROLES") && long.contains("\n  learner "), "{long}");
    assert!(long.contains("EXAMPLES"), "{long}");
}

#[test]
fn usage_errors_suggest_the_nearest_valid_value() {
    for (arguments, expected) in [
        (&["tain"][..], "'train'"),
        (&["train", "reachr"], "did you mean `reacher`"),
        (&["train", "reacher", "--stps", "5"], "'--steps'"),
        (&["bench", "rollot"], "'rollout'"),
        (&["bench", "rollout", "--task", "reachr"], "did you mean `reacher`"),
        (&["train", "reacher", "--policy", "dpm"], "possible values: dmp, mlp"),
        (&["train", "reacher", "--algo", "dpg"], "'ddpg'"),
        (&["train", "reacher", "--preset", "papr"], "'paper'"),
        (
            &["train", "reacher", "--set", "algorithm.bach_size=3"],
            "did you mean `algorithm.batch_size`",
        ),
        (&["train", "reacher", "--set", "algorithm.critic=last"], "segment"),
    ] {
        let said = refused(arguments);
        assert!(said.contains(expected), "{arguments:?}: {said}");
        assert!(said.starts_with("error: "), "{said}");
    }
}

#[test]
fn invalid_values_are_usage_errors() {
    for arguments in [
        &["train"][..],
        &["train", "reacher", "--steps", "0"],
        &["train", "reacher", "--steps", "-5"],
        &["train", "reacher", "--threads", "2000"],
        #[cfg(not(feature = "cuda"))]
        &["train", "reacher", "--device", "cuda"],
        #[cfg(not(feature = "cuda"))]
        &["bench", "learner", "--task", "reacher", "--device", "cuda"],
        &["train", "reacher", "--max-minutes", "0"],
        &["train", "reacher", "--set", "dmp.alpha_y=1000"],
        &["train", "reacher", "--deterministic", "--workers", "4"],
        &["train", "reacher", "--set", "dmp.alpha_x=40"],
        &["train", "reacher", "--init-from", "Cargo.toml"],
        &["train", "reacher", "--config", "/nowhere/at/all.toml"],
        &["train", "reacher", "--python-path", "/nowhere/at/all"],
        &["train", "reacher", "--init-from", "/nowhere/at/all"],
        &["train", "reacher", "--run-dir", "runs/.."],
        &["resume", "/nowhere/at/all"],
        &["eval", "/nowhere/at/all"],
        &["eval", "/nowhere/at/all", "--policy", "worst"],
        &["eval", "/nowhere/at/all", "--episodes", "0"],
        &["bench"],
        &["bench", "rollout"],
        &["bench", "rollout", "--task", "reacher", "--seconds", "0"],
        &["bench", "rollout", "--task", "reacher", "--seconds", "nan"],
        &["bench", "rollout", "--task", "reacher", "--rounds", "0"],
        &["bench", "rollout", "--task", "reacher", "--workers", "100000"],
        &["bench", "rollout", "--task", "reacher", "--peer-python", "/nowhere/at/all"],
        &["learner", "--run", "x"],
    ] {
        refused(arguments);
    }
}

#[test]
fn an_unknown_dmprl_variable_is_a_usage_error() {
    let output = Command::new(env!("CARGO_BIN_EXE_dmprl"))
        .args(["train", "reacher"])
        .env("DMPRL_RUN__STEP", "5")
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("DMPRL_RUN__STEP") && said.contains("`run.steps`"), "{said}");
}

fn new_run(path: &Path) -> RunDirectory {
    let manifest = Manifest::new(None).unwrap();
    RunDirectory::create(path, &ExperimentConfig::default(), &manifest).unwrap()
}

#[test]
fn a_run_directory_in_use_is_rejected_with_advice() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent.path().join("run"));
    let path = run.path().to_str().unwrap();
    let said = refused(&["train", "reacher", "--run-dir", path]);
    assert!(said.contains(&format!("dmprl resume {path}")), "{said}");
    let said = refused(&["eval", path]);
    assert!(said.contains("no evaluation yet"), "{said}");
}

#[test]
fn a_run_of_a_newer_format_fails_with_its_version() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent.path().join("run"));
    std::fs::write(run.path().join("manifest.json"), r#"{"format_version": 99}"#).unwrap();
    let output = dmprl(&["resume", run.path().to_str().unwrap()]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("format version 99"), "{said}");
}

#[test]
fn tasks_are_listed_as_text_and_as_json() {
    let text = stdout(&dmprl(&["tasks"]));
    assert!(text.contains("reacher") && text.contains("Pusher-v5"), "{text}");
    let json: serde_json::Value =
        serde_json::from_str(&stdout(&dmprl(&["tasks", "--json"]))).unwrap();
    assert_eq!(json["tasks"][0]["name"], "reacher");
}
