//! Tests of the run directory: rejected paths and formats, partial lines, choices, the lock.

use std::fs;
use std::io::Write;
use std::time::Duration;

use dmprl_shared::supervision::EvaluationRow;

use super::*;
use crate::PolicyChoice;
use crate::failure::WrongUse;

fn new_run(parent: &tempfile::TempDir) -> RunDirectory {
    let manifest = Manifest::new(None).unwrap();
    RunDirectory::create(&parent.path().join("run"), &ExperimentConfig::default(), &manifest)
        .unwrap()
}

fn row(policy_version: u64, return_mean: f64) -> EvaluationRow {
    EvaluationRow {
        env_steps: policy_version * 100,
        updates: 1,
        segments: 1,
        wall_s: policy_version as f64,
        policy_version,
        returns: vec![return_mean, 0.1 + 0.2],
        return_mean,
        success_rate: None,
        smoothness: 0.5,
        at_bounds: None,
    }
}

#[test]
fn written_files_are_read_back() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let opened = RunDirectory::open(run.path()).unwrap();
    assert_eq!(opened.config().unwrap(), ExperimentConfig::default());
    assert_eq!(opened.manifest().unwrap(), run.manifest().unwrap());
    assert_eq!(opened.spec().unwrap(), None);
    run.append_evaluation(&row(3, -1.5)).unwrap();
    assert_eq!(opened.evaluations().unwrap(), [row(3, -1.5)]);
}

#[test]
fn a_directory_with_files_is_rejected_with_advice() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let error = RunDirectory::check_free(run.path()).unwrap_err();
    assert!(error.downcast_ref::<WrongUse>().is_some());
    assert!(error.to_string().contains("dmprl resume"), "{error}");
    let empty = parent.path().join("empty");
    fs::create_dir(&empty).unwrap();
    RunDirectory::check_free(&empty).unwrap();
}

#[test]
fn unsafe_names_are_rejected() {
    let long = "x".repeat(NAME_LEN_MAX + 1);
    for name in ["..", "runs/..", "/", "", ".hidden", "-flag", "a b", "a\nb", "a:b", "ü", &long] {
        let error = RunDirectory::check_free(Path::new(name)).unwrap_err();
        assert!(error.downcast_ref::<WrongUse>().is_some(), "{name:?}: {error}");
    }
    assert_eq!(safe_name("my.module:Arm-v0"), "my.module_Arm-v0");
    assert_eq!(safe_name("../_x/etc"), "x_etc");
}

#[test]
fn a_newer_format_is_rejected_with_its_version() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let text = r#"{"format_version": 7, "shape": "unheard of"}"#;
    fs::write(run.path().join("manifest.json"), text).unwrap();
    let error = format!("{:#}", RunDirectory::open(run.path()).unwrap_err());
    assert!(error.contains("format version 7 is newer than 1"), "{error}");
}

#[test]
fn a_partial_last_line_is_ignored_and_the_next_append_replaces_it() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    run.append_evaluation(&row(1, -3.0)).unwrap();
    let mut file = fs::OpenOptions::new().append(true).open(run.evaluations_path()).unwrap();
    file.write_all(br#"{"env_steps": 200, "upd"#).unwrap();
    assert_eq!(run.evaluations().unwrap(), [row(1, -3.0)]);
    assert_eq!(run.wall_s_before().unwrap(), 1.0);
    run.append_evaluation(&row(2, -2.0)).unwrap();
    assert_eq!(run.evaluations().unwrap(), [row(1, -3.0), row(2, -2.0)]);
}

#[test]
fn an_invalid_line_is_reported_with_its_number() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    run.append_evaluation(&row(1, -3.0)).unwrap();
    let mut file = fs::OpenOptions::new().append(true).open(run.evaluations_path()).unwrap();
    file.write_all(b"{}\n").unwrap();
    assert!(run.evaluations().unwrap_err().to_string().contains("line 2"));
}

#[test]
fn a_row_with_nan_is_rejected_before_it_is_written() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    assert!(run.append_evaluation(&row(1, f64::NAN)).is_err());
    assert_eq!(run.evaluations().unwrap(), []);
}

#[test]
fn best_has_the_highest_mean_return_and_latest_is_the_last_row() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let none = run.choose_policy(PolicyChoice::Best).unwrap_err();
    assert!(none.to_string().contains("no evaluation yet"), "{none}");
    for (version, return_mean) in [(1, -3.0), (2, -1.0), (3, -2.0)] {
        fs::write(run.policy_path(version), "").unwrap();
        run.append_evaluation(&row(version, return_mean)).unwrap();
    }
    assert_eq!(run.choose_policy(PolicyChoice::Best).unwrap().version, 2);
    assert_eq!(run.choose_policy(PolicyChoice::Latest).unwrap().version, 3);
    assert_eq!(run.choose_policy(PolicyChoice::Version(1)).unwrap().row, Some(row(1, -3.0)));
    let missing = run.choose_policy(PolicyChoice::Version(9)).unwrap_err();
    assert!(missing.to_string().contains("saved: 1, 2, 3"), "{missing}");
}

#[test]
fn the_best_policy_has_the_highest_success_rate_of_those_that_are_saved() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let rates = [(1, -48.0, 0.1), (2, -49.0, 0.6), (3, -49.5, 0.6), (4, -49.9, 0.7)];
    for (version, return_mean, success_rate) in rates {
        fs::write(run.policy_path(version), "").unwrap();
        let row = EvaluationRow { success_rate: Some(success_rate), ..row(version, return_mean) };
        run.append_evaluation(&row).unwrap();
    }
    assert_eq!(run.choose_policy(PolicyChoice::Best).unwrap().version, 4);
    // An earlier version of the program kept other policies.
    fs::remove_file(run.policy_path(4)).unwrap();
    assert_eq!(run.choose_policy(PolicyChoice::Best).unwrap().version, 2);
}

#[test]
fn pruning_keeps_best_latest_checkpointed_and_unevaluated_policies() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    for version in 1..=6 {
        fs::write(run.policy_path(version), "").unwrap();
    }
    run.prune_policies(&[]).unwrap();
    assert_eq!(run.saved_policies().unwrap().len(), 6, "nothing evaluated, nothing removed");
    for (version, return_mean) in [(1, -3.0), (2, -1.0), (3, -2.0), (4, -2.0)] {
        run.append_evaluation(&row(version, return_mean)).unwrap();
    }
    run.prune_policies(&[3]).unwrap();
    assert_eq!(run.saved_policies().unwrap().into_iter().collect::<Vec<_>>(), [2, 3, 4, 5, 6]);
}

#[test]
fn rewinding_removes_rows_after_the_checkpoint_and_keeps_the_rest_unchanged() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    fs::write(
        run.metrics_path(),
        "{\"env_steps\": 100,  \"loss\": 0.10}\n{\"env_steps\": 300}\n{\"env_st",
    )
    .unwrap();
    run.append_evaluation(&row(1, -3.0)).unwrap();
    run.append_evaluation(&row(2, -3.0)).unwrap();
    run.rewind(150).unwrap();
    let metrics = fs::read_to_string(run.metrics_path()).unwrap();
    assert_eq!(metrics, "{\"env_steps\": 100,  \"loss\": 0.10}\n");
    assert_eq!(run.evaluations().unwrap(), [row(1, -3.0)]);
}

/// Processes that were killed while they rewrote a file used to leave a temporary file for good.
#[test]
fn only_temporary_files_of_killed_writers_are_removed() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let checkpoints = run.checkpoints_path();
    fs::create_dir(checkpoints.join(".000002.tmp")).unwrap();
    let temporary =
        ["evaluations.tmp21405", "segments.tmp", "policies/12.tmp", "checkpoints/best.tmp7"];
    let kept = ["policies/12.safetensors", "evaluations.jsonl", "segments.log", "my.tmpfile"];
    for name in temporary.iter().chain(&kept) {
        fs::write(run.path().join(name), "").unwrap();
    }
    std::os::unix::fs::symlink("nowhere", checkpoints.join(".latest.tmp")).unwrap();
    run.remove_half_written().unwrap();
    let exists = |name: &&&str| run.path().join(name).symlink_metadata().is_ok();
    assert_eq!(temporary.iter().filter(exists).count(), 0);
    assert_eq!(kept.iter().filter(exists).count(), kept.len());
    assert!(checkpoints.join(".latest.tmp").symlink_metadata().is_err());
    assert!(checkpoints.join(".000002.tmp").is_dir());
}

#[test]
fn a_second_trainer_of_a_run_is_rejected() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let held = run.lock(Duration::ZERO).unwrap();
    let error = run.lock(Duration::ZERO).unwrap_err().to_string();
    assert!(error.contains(&format!("process {}", std::process::id())), "{error}");
    drop(held);
    // A process that another test starts concurrently may hold the descriptor a while longer.
    run.lock(Duration::from_secs(60)).unwrap();
}
