//! Files of a finished run, and their use by other commands.

use std::fs;
use std::path::Path;

use dmprl_tests::program::{Workplace, env_steps, json_file, rows, shared_memory_of};
use serde_json::Value;

use crate::train;

const ROW_KEYS: [&str; 9] = [
    "env_steps",
    "updates",
    "segments",
    "wall_s",
    "policy_version",
    "returns",
    "return_mean",
    "success_rate",
    "smoothness",
];

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("{key} of {row}"))
}

#[test]
fn training_with_two_workers_leaves_a_whole_run_directory_and_nothing_else() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = ["--steps", "2500", "--workers", "2", "--set", "evaluation.final_episodes=6"];
    let finished = place
        .run(&train("reacher", &run, &more))
        .with_status(0)
        .saying("first environment step after")
        .saying("evaluation at 2,500 steps")
        .saying("  return ")
        .saying("dmprl eval");
    assert_eq!(finished.printed, "", "standard output is for results that were asked for");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new());

    for file in [
        "config.toml",
        "manifest.json",
        "metrics.jsonl",
        "evaluations.jsonl",
        "checkpoints/latest/state.json",
        "checkpoints/best",
        "logs/learner.log",
        "logs/actor-0.log",
        "logs/actor-1.log",
        "logs/evaluator.log",
        "plots/learning_curve.svg",
        "plots/learning_curve.png",
    ] {
        assert!(Path::new(&run).join(file).is_file(), "no {file}");
    }
    let evaluations = rows(&run, "evaluations.jsonl");
    for row in &evaluations {
        let keys: Vec<&str> = row.as_object().unwrap().keys().map(String::as_str).collect();
        assert!(ROW_KEYS.iter().all(|key| keys.contains(key)), "{row}");
        let returns: Vec<f64> = row["returns"]
            .as_array()
            .unwrap()
            .iter()
            .map(|value| value.as_f64().unwrap())
            .collect();
        // The last evaluation has evaluation.final_episodes.
        let episodes = if row["env_steps"].as_u64() >= Some(2500) { 6 } else { 4 };
        assert_eq!(returns.len(), episodes);
        let mean = returns.iter().sum::<f64>() / episodes as f64;
        assert!((mean - number(row, "return_mean")).abs() < 1e-9, "{row}");
    }
    // Workers send complete segments, so a step limit is met within one segment.
    let steps: Vec<u64> = env_steps(&evaluations).iter().map(|steps| steps / 5 * 5).collect();
    assert_eq!(steps, [1000, 2000, 2500]);
    let metrics = rows(&run, "metrics.jsonl");
    assert_eq!(env_steps(&metrics), [500, 1000, 1500, 2000, 2500]);
    let last = metrics.last().unwrap();
    assert_eq!(last["rejected"].as_object().unwrap().values().find(|count| **count != 0), None);
    assert_eq!(number(last, "updates_owed"), 0.0);
    assert_eq!(json_file(&run, "checkpoints/latest/state.json")["counters"]["env_steps"], 2500);
}

#[test]
fn the_manifest_says_what_each_session_ran_on_and_with_which_configuration() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "500"])).with_status(0);
    place.run(&["resume", &run, "--steps", "1000"]).with_status(0);
    let sessions = json_file(&run, "manifest.json")["sessions"].clone();
    let [first, second] = sessions.as_array().unwrap().as_slice() else { panic!("{sessions}") };
    for session in [first, second] {
        for package in ["python", "mujoco", "gymnasium", "numpy"] {
            let version = session["packages"][package].as_str().unwrap_or_default();
            assert!(version.starts_with(|digit: char| digit.is_ascii_digit()), "{session}");
        }
        for hash in [&session["config_sha256"], &session["packages"]["dmprl_sha256"]] {
            assert_eq!(hash.as_str().unwrap_or_default().len(), 64, "{session}");
        }
        // The tests are built from a clone.
        assert!(session["git_commit"].as_str().unwrap_or_default().len() >= 40, "{session}");
    }
    assert_ne!(first["config_sha256"], second["config_sha256"], "run.steps has changed");
    assert_eq!(first["packages"], second["packages"]);
}

#[test]
fn eval_repeats_the_stored_evaluations() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "2000"])).with_status(0);
    let before = fs::read(Path::new(&run).join("evaluations.jsonl")).unwrap();
    let stored = rows(&run, "evaluations.jsonl");
    let best =
        stored.iter().max_by(|a, b| number(a, "return_mean").total_cmp(&number(b, "return_mean")));
    for (policy, row) in [("best", best.unwrap()), ("latest", stored.last().unwrap())] {
        let again = place.run(&["eval", &run, "--policy", policy, "--json"]).with_status(0).json();
        for key in ["return_mean", "smoothness"] {
            assert!((number(&again, key) - number(row, key)).abs() < 1e-6, "{policy}: {again}");
        }
        assert_eq!(again["success_rate"], row["success_rate"]);
        let pairs =
            again["returns"].as_array().unwrap().iter().zip(row["returns"].as_array().unwrap());
        for (again, stored) in pairs {
            assert!((again.as_f64().unwrap() - stored.as_f64().unwrap()).abs() < 1e-6);
        }
    }
    let shown = place.run(&["eval", &run]).with_status(0).printed;
    assert!(shown.contains("(the same)"), "{shown}");
    assert_eq!(fs::read(Path::new(&run).join("evaluations.jsonl")).unwrap(), before);
    place.assert_no_process();
}

/// A run that was stopped before its evaluator answered has a checkpoint without the row of its
/// evaluation.
#[test]
fn a_resumed_run_makes_up_for_the_evaluation_that_was_never_answered() {
    for mode in [None, Some("--deterministic")] {
        let place = Workplace::new();
        let run = place.path("run");
        let flags: Vec<&str> = ["--steps", "2000"].into_iter().chain(mode).collect();
        place.run(&train("reacher", &run, &flags)).with_status(0);
        let path = Path::new(&run).join("evaluations.jsonl");
        let text = fs::read_to_string(&path).unwrap();
        let (answered, _) = text.split_once('\n').unwrap();
        fs::write(&path, format!("{answered}\n")).unwrap();

        place.run(&["resume", &run, "--steps", "2500"]).with_status(0);
        let evaluated = env_steps(&rows(&run, "evaluations.jsonl"));
        assert_eq!(evaluated, [1000, 2000, 2500], "{mode:?}");
    }
}

#[test]
fn resume_with_more_steps_extends_a_finished_run() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1500"])).with_status(0);
    let first = rows(&run, "metrics.jsonl");
    place.run(&["resume", &run, "--steps", "3000"]).with_status(0).saying("evaluation at 3,000");
    let metrics = rows(&run, "metrics.jsonl");
    assert_eq!(metrics[..first.len()], first, "earlier rows stay");
    assert_eq!(env_steps(&metrics), [500, 1000, 1500, 2000, 2500, 3000]);
    assert_eq!(env_steps(&rows(&run, "evaluations.jsonl")), [1000, 1500, 2000, 3000]);
    let clock: Vec<f64> = metrics.iter().map(|row| number(row, "wall_s")).collect();
    assert!(clock.is_sorted(), "time continues where it stopped: {clock:?}");
    assert_eq!(json_file(&run, "manifest.json")["sessions"].as_array().unwrap().len(), 2);

    place
        .run(&["resume", &run, "--steps", "2000"])
        .with_status(2)
        .saying("the run already has 3000 steps");

    // No steps are left: reported, not trained again.
    place.run(&["resume", &run]).with_status(0).saying("  return ");
    assert_eq!(rows(&run, "metrics.jsonl"), metrics);
    assert_eq!(env_steps(&rows(&run, "evaluations.jsonl")), [1000, 1500, 2000, 3000]);
}

#[test]
fn a_warm_start_begins_with_the_given_policy() {
    let place = Workplace::new();
    let (source, run) = (place.path("source"), place.path("run"));
    place.run(&train("reacher", &source, &["--steps", "1500"])).with_status(0);
    // The steps are so small that they vanish in the rounding of a parameter. The first evaluation
    // is that of the given policy, except for the rounding of its first layer when observations are
    // normalised.
    let still = ["--init-from", &source, "--set", "algorithm.actor_learning_rate=1e-15"];
    let more = [&still[..], &["--steps", "1000", "--seed", "9"]].concat();
    place.run(&train("reacher", &run, &more)).with_status(0);
    let best = rows(&source, "evaluations.jsonl")
        .iter()
        .map(|row| number(row, "return_mean"))
        .fold(f64::NEG_INFINITY, f64::max);
    let warm = rows(&run, "evaluations.jsonl");
    assert!((number(&warm[0], "return_mean") - best).abs() < 1e-4, "{best}: {warm:?}");
    let manifest = json_file(&run, "manifest.json");
    assert!(manifest["init_from"].as_str().unwrap().starts_with(&source), "{manifest}");
}
