//! Tests a whole session with fake children: shared memory, lock, plots and resuming.
#![allow(clippy::unwrap_used)] // helpers of tests fail as tests do

mod fakes;

use dmprl::cli::{TrainingPlan, train_session};
use dmprl::terminal::ProgressStyle;
use dmprl_control::EvaluationRow;
use dmprl_run::failure::Outcome;
use dmprl_supervisor::Trial;
use fakes::{Fixture, PATIENCE, fake_role};

fn plan(fixture: &Fixture, resume: bool) -> TrainingPlan {
    TrainingPlan {
        trial: Trial::default(),
        program: fake_role(),
        run: fixture.run.clone(),
        // A child of a concurrent test may briefly hold the lock's descriptor.
        lock: fixture.run.lock(PATIENCE).unwrap(),
        config: fixture.config.clone(),
        venv: None,
        resume,
        progress: ProgressStyle::Lines,
    }
}

fn row(policy_version: u64) -> EvaluationRow {
    EvaluationRow {
        env_steps: 10,
        updates: 1,
        segments: 1,
        wall_s: 1.0,
        policy_version,
        returns: vec![-3.0, -2.0],
        return_mean: -2.5,
        success_rate: None,
        smoothness: 0.0,
        at_bounds: None,
    }
}

/// Lists the shared-memory directories of this run.
fn domains(fixture: &Fixture) -> Vec<String> {
    let parent = format!("/dev/shm/dmprl-{}", rustix::process::getuid().as_raw());
    let Ok(entries) = std::fs::read_dir(parent) else { return Vec::new() };
    let run_id = fixture.run.manifest().unwrap().run_id;
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.contains(&run_id)).collect()
}

#[test]
fn a_session_leaves_a_plot_and_neither_shared_memory_nor_a_lock() {
    let fixture = Fixture::new(&[]);
    fixture.run.append_evaluation(&row(1)).unwrap();
    assert_eq!(train_session(plan(&fixture, false)).unwrap(), Outcome::Done);
    assert!(fixture.run.path().join("plots/learning_curve.svg").is_file());
    assert_eq!(domains(&fixture), Vec::<String>::new());
    fixture.assert_no_child_lives();
    fixture.run.lock(PATIENCE).unwrap();
}

#[test]
fn children_hold_the_lock_of_the_run() {
    let fixture = Fixture::new(&[("learner", "asks-for-the-lock")]);
    assert_eq!(train_session(plan(&fixture, false)).unwrap(), Outcome::Done);
    assert!(fixture.seen("learner").contains("locked"), "{}", fixture.seen("learner"));
}

#[test]
fn a_run_without_a_checkpoint_starts_over_without_its_old_rows() {
    let fixture = Fixture::new(&[]);
    fixture.run.append_evaluation(&row(1)).unwrap();
    fixture.run.point_best().unwrap();
    assert_eq!(train_session(plan(&fixture, true)).unwrap(), Outcome::Done);
    assert_eq!(fixture.run.evaluations().unwrap(), []);
    assert!(fixture.run.checkpoints_path().join("best").symlink_metadata().is_err());
    assert!(!fixture.seen("learner").contains("resumed"));
}

#[test]
fn a_run_with_a_checkpoint_resumes_from_it() {
    let fixture = Fixture::new(&[]);
    fixture.run.append_evaluation(&row(1)).unwrap();
    // No `latest`: a run may have been copied without its symbolic links.
    std::fs::create_dir(fixture.run.checkpoints_path().join("000001")).unwrap();
    assert_eq!(train_session(plan(&fixture, true)).unwrap(), Outcome::Done);
    assert!(fixture.seen("learner").contains("resumed"));
    assert_eq!(fixture.run.evaluations().unwrap(), [row(1)]);
}

#[test]
fn a_failed_session_returns_its_reason_and_leaves_no_shared_memory() {
    let fixture = Fixture::new(&[("learner", "dies")]);
    let error = train_session(plan(&fixture, false)).unwrap_err();
    assert!(error.to_string().contains("learner died"), "{error}");
    assert_eq!(domains(&fixture), Vec::<String>::new());
}
