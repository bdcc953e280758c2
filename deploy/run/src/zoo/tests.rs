//! Tests of the copies of policies that come with the package.

use std::fs;

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::supervision::EvaluationRow;

use super::*;
use crate::directory::FOLDERS;
use crate::failure::WrongUse;
use crate::manifest::Manifest;

/// Makes a package with the policy `lift`.
fn package() -> (tempfile::TempDir, Zoo) {
    let package = tempfile::tempdir().unwrap();
    let folder = package.path().join("zoo/lift");
    let manifest = Manifest::new(None).unwrap();
    let run = RunDirectory::create(&folder, &ExperimentConfig::default(), &manifest).unwrap();
    run.append_evaluation(&EvaluationRow {
        env_steps: 1,
        updates: 1,
        segments: 1,
        wall_s: 1.0,
        policy_version: 7,
        returns: vec![-1.0],
        return_mean: -1.0,
        success_rate: None,
        smoothness: 0.5,
        at_bounds: None,
    })
    .unwrap();
    fs::write(folder.join("spec.json"), "{}").unwrap();
    fs::write(folder.join("policies/7.safetensors"), "parameters").unwrap();
    fs::write(package.path().join("zoo/__init__.py"), "").unwrap();
    let zoo = Zoo::of_package(package.path());
    (package, zoo)
}

#[test]
fn only_names_with_the_prefix_are_of_the_zoo() {
    assert_eq!(Zoo::name(Path::new("zoo:lift")), Some("lift"));
    assert_eq!(Zoo::name(Path::new("runs/zoo:lift")), None);
    assert_eq!(Zoo::name(Path::new("lift")), None);
}

#[test]
fn a_policy_is_copied_once_into_a_run_directory() {
    let (_package, zoo) = package();
    let home = tempfile::tempdir().unwrap();
    let runs = home.path().join("runs");
    let run = zoo.open("lift", &runs).unwrap();
    assert_eq!(run.saved_policies().unwrap().into_iter().collect::<Vec<_>>(), [7]);
    assert!(run.path().ends_with("runs/zoo-lift"));
    assert!(FOLDERS.iter().all(|folder| run.path().join(folder).is_dir()));
    fs::write(run.log_path("evaluator"), "kept").unwrap();
    let again = zoo.open("lift", &runs).unwrap();
    assert_eq!(fs::read_to_string(again.log_path("evaluator")).unwrap(), "kept");
    assert_eq!(runs.read_dir().unwrap().count(), 1, "nothing temporary remains");
}

#[test]
fn the_copy_is_marked_and_links_its_best_policy() {
    let (_package, zoo) = package();
    let runs = tempfile::tempdir().unwrap();
    let run = zoo.open("lift", runs.path()).unwrap();
    assert_eq!(run.copied_from().as_deref(), Some("zoo:lift"));
    let best = fs::read_to_string(run.checkpoints_path().join("best")).unwrap();
    assert_eq!(best, "parameters");
}

#[test]
fn a_command_that_copies_at_the_same_time_leaves_nothing_behind() {
    let (_package, zoo) = package();
    let runs = tempfile::tempdir().unwrap();
    let run = zoo.open("lift", runs.path()).unwrap();
    let original = RunDirectory::open(&zoo.folder.join("lift")).unwrap();
    original.copy_policy("zoo:lift", run.path()).unwrap();
    assert_eq!(runs.path().read_dir().unwrap().count(), 1);
}

#[test]
fn a_copy_of_an_older_version_is_not_used() {
    let (_package, zoo) = package();
    let runs = tempfile::tempdir().unwrap();
    zoo.open("lift", runs.path()).unwrap();
    let original = RunDirectory::open(&zoo.folder.join("lift")).unwrap();
    let longer = Manifest { init_from: Some("zoo:lift".into()), ..original.manifest().unwrap() };
    original.write_manifest(&longer).unwrap();
    let error = zoo.open("lift", runs.path()).unwrap_err().to_string();
    assert!(error.contains("of another version of dmprl"), "{error}");
}

#[test]
fn an_unknown_name_is_rejected_with_the_known_ones() {
    let (_package, zoo) = package();
    let home = tempfile::tempdir().unwrap();
    for name in ["drop", "", "..", "lift/../lift"] {
        let error = zoo.open(name, home.path()).unwrap_err();
        assert!(error.downcast_ref::<WrongUse>().is_some(), "{name}");
        assert!(error.to_string().contains("expected one of lift"), "{error}");
    }
    assert_eq!(home.path().read_dir().unwrap().count(), 0);
}

#[test]
fn another_run_in_the_place_of_the_copy_is_not_used() {
    let (_package, zoo) = package();
    let runs = tempfile::tempdir().unwrap();
    let manifest = Manifest::new(None).unwrap();
    let place = runs.path().join("zoo-lift");
    RunDirectory::create(&place, &ExperimentConfig::default(), &manifest).unwrap();
    let error = zoo.open("lift", runs.path()).unwrap_err().to_string();
    assert!(error.contains("zoo-lift is another run"), "{error}");
}
