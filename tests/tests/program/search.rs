//! `dmprl sweep` of a file with `[search]`: real Optuna, short real runs.

use std::fs;
use std::path::Path;

use dmprl_tests::program::{Workplace, env_steps, env_steps_of_checkpoint, json_file, rows};
use rustix::process::Signal;
use serde_json::Value;

use crate::SMALL;

/// `values` of `search.space`, `search.first` and more.
fn write(place: &Workplace, steps: u64, seeds: &str, values: &str) -> String {
    let file = place.path("small.toml");
    let text = format!(
        "seeds = {seeds}\n[[task]]\nname = 'reacher'\nsteps = {steps}\n[[method]]\nname = 'mlp'\n\
         policy = 'mlp'\n[set]\n{}\n[search]\n{values}",
        SMALL.join("\n")
    );
    fs::write(&file, text).unwrap();
    file
}

fn trial(json: &Value, number: usize) -> &Value {
    let trial = &json["trials"][number];
    assert_eq!(trial["trial"], number, "{json:#}");
    trial
}

fn states(json: &Value) -> Vec<&str> {
    json["trials"]
        .as_array()
        .unwrap()
        .iter()
        .map(|trial| trial["state"].as_str().unwrap())
        .collect()
}

/// Number of sessions of a run.
fn sessions(run: &str) -> usize {
    json_file(run, "manifest.json")["sessions"].as_array().unwrap().len()
}

/// A large learning rate drives the actor to the limits of its actions within the first updates; an
/// actor that learns nothing does ten times as well. The two trials come first, in this order. The
/// bad one has so many updates that it cannot finish before it is pruned.
const GOOD_AND_BAD: &str = "
    trials = 2
    prune_after_trials = 1
    [search.space]
    algorithm.actor_learning_rate = [1e-5, 10.0]
    pacing.updates_per_segment = { low = 0.5, high = 50 }
    [[search.first]]
    algorithm.actor_learning_rate = 1e-5
    pacing.updates_per_segment = 0.5
    [[search.first]]
    algorithm.actor_learning_rate = 10.0
    pacing.updates_per_segment = 50
";

#[test]
fn a_search_gives_up_the_bad_trial_and_hands_over_the_best() {
    let place = Workplace::new();
    let file = write(&place, 5_000, "[1, 2]", GOOD_AND_BAD);
    let listed = place.run(&["sweep", &file, "--dry-run", "--json"]).with_status(0).json();
    assert_eq!((listed["search"]["trials"].clone(), states(&listed)), (2.into(), vec![]));
    assert!(!Path::new(&place.path("runs")).exists(), "a dry run makes nothing");

    let finished = place.run(&["sweep", &file, "--jobs", "1", "--json"]).with_status(0);
    let finished = finished.saying("trial 1 · algorithm.actor_learning_rate=10.0");
    let json = finished.saying("pruned at").json();
    assert_eq!(states(&json), ["finished", "pruned"]);
    let (good, bad) = (trial(&json, 0), trial(&json, 1));
    let run = |trial: &Value, index: usize| trial["runs"][index].as_str().unwrap().to_owned();

    // The objective is the mean of the last evaluations of both seeds, on the tuning seeds.
    let last = |run: &str| rows(run, "evaluations.jsonl").pop().unwrap()["return_mean"].clone();
    let returns = [0, 1].map(|seed| last(&run(good, seed)).as_f64().unwrap());
    let objective = good["objective"].as_f64().unwrap();
    assert!((objective - (returns[0] + returns[1]) / 2.0).abs() < 1e-9, "{returns:?} {objective}");
    let config = fs::read_to_string(Path::new(&run(good, 0)).join("config.toml")).unwrap();
    assert!(config.contains("first_seed = 5000"), "{config}");

    // Pruned in the middle of the first seed, with a checkpoint; the second seed never began.
    assert_eq!(bad["runs"].as_array().unwrap().len(), 1);
    let reached = env_steps_of_checkpoint(&run(bad, 0)).unwrap();
    assert!((1_000..5_000).contains(&reached), "{reached}");
    let ledger = rows(&place.path("runs/small"), "finished.jsonl");
    let entry = |run: &str| ledger.iter().find(|entry| entry["run"] == run).unwrap();
    assert_eq!(entry("reacher/mlp/trial-001/seed-1")["state"], "pruned");
    assert_eq!(entry("reacher/mlp/trial-000/seed-2")["state"], Value::Null);

    // `train` accepts its output, and evaluates it on the evaluation's own seeds.
    let best = &json["best"][0];
    let config = best["config"].as_str().unwrap();
    let trained = place.path("anew");
    let train = ["train", "reacher", "--config", config, "--steps", "200", "--run-dir", &trained];
    place.run(&train).with_status(0);
    let config = fs::read_to_string(Path::new(&trained).join("config.toml")).unwrap();
    assert!(config.contains("first_seed = 1000"), "{config}");
    assert!(config.contains("actor_learning_rate = 0.00001"), "{config}");
    assert!(best["set"].as_str().unwrap().contains("--set algorithm.actor_learning_rate=0.00001"));

    // Nothing is left to do; it prints the trials and reports the best.
    let again = place.run(&["sweep", &file, "--json"]).with_status(0).json();
    assert_eq!(again["trials"], json["trials"]);
    assert_eq!(sessions(&run(good, 0)), 1, "a finished run is not repeated");
    let listed = place.run(&["sweep", &file, "--dry-run"]).with_status(0);
    assert!(listed.printed.contains("pruned"), "{}", listed.printed);
    let report = place.run(&["report", "runs/small", "--json"]).with_status(0).json();
    assert_eq!(report["methods"], serde_json::json!(["mlp, best trial"]));
    let cell = &report["tables"][0]["rows"][0][1][0];
    assert_eq!(cell["summary"]["count"], 2, "both seeds of the best trial: {report:#}");
    place.assert_no_process();
}

#[test]
fn a_search_that_is_killed_goes_on_with_the_trials_under_way() {
    let place = Workplace::new();
    let space = "trials = 2\npruner = 'none'\n[search.space]\n\
                 algorithm.actor_learning_rate = { low = 1e-5, high = 1e-3, log = true }\n\
                 dmp.basis_count = { low = 3, high = 7 }\n";
    let file = write(&place, 12_000, "[1]", space);
    let mut asked = Vec::new();
    for signal in [Signal::INT, Signal::KILL] {
        let mut running = place.start(&["sweep", &file, "--jobs", "2", "--json"]);
        let run = place.path("runs/small/reacher/mlp/trial-001/seed-1");
        let before = env_steps_of_checkpoint(&run).unwrap_or(0);
        running.until("a checkpoint", |_| {
            env_steps_of_checkpoint(&run).is_some_and(|steps| steps > before)
        });
        running.signal(signal);
        let finished = running.wait();
        if signal == Signal::INT {
            let json = finished.with_status(130).saying("resume with: dmprl sweep").json();
            asked.extend([0, 1].map(|number| trial(&json, number)["values"].clone()));
            assert_eq!(trial(&json, 1)["state"], "running");
        }
        place.until_no_process();
    }
    let json = place.run(&["sweep", &file, "--jobs", "2", "--json"]).with_status(0).json();
    assert_eq!(states(&json), ["finished", "finished"]);
    let values = [0, 1].map(|number| trial(&json, number)["values"].clone());
    assert_eq!(values.to_vec(), asked, "nothing was asked for again");
    let run = trial(&json, 1)["runs"][0].as_str().unwrap();
    assert_eq!(sessions(run), 3);
    let steps = env_steps(&rows(run, "evaluations.jsonl"));
    assert!(steps.is_sorted_by(|a, b| a < b), "{steps:?}");

    // A different space in the same folder is refused before anything starts.
    let other = write(&place, 12_000, "[1]", &space.replace("1e-5", "1e-6"));
    let kept = place.path("runs/small/sweep.toml");
    let before = fs::read_to_string(&kept).unwrap();
    place.run(&["sweep", &other]).with_status(1).saying("space").saying("--output");
    assert_eq!(fs::read_to_string(&kept).unwrap(), before, "the file is unchanged");
}

#[test]
fn a_search_whose_every_trial_fails_gives_up() {
    let place = Workplace::new();
    fs::write(place.path("flaky_arm.py"), "raise RuntimeError('no arm here')\n").unwrap();
    let file = place.path("small.toml");
    let text = format!(
        "seeds = [1]\n[[task]]\nname = 'flaky_arm:Arm-v0'\nsteps = 300\n\
         set = {{ task.python_path = ['{}'] }}\n\
         [search]\ntrials = 9\nspace = {{ dmp.basis_count = {{ low = 3, high = 7 }} }}\n",
        place.path("")
    );
    fs::write(&file, text).unwrap();
    let finished = place.run(&["sweep", &file, "--jobs", "2", "--json"]).with_status(1);
    let finished = finished.saying("5 trials in a row have failed").saying("no arm here");
    let json = finished.json();
    let failed = states(&json).iter().filter(|state| **state == "failed").count();
    assert!((5..=6).contains(&failed), "{json:#}");
    assert_eq!(json["best"], Value::Array(Vec::new()));
}

#[test]
fn a_mistake_in_a_search_is_told_before_anything_starts() {
    let place = Workplace::new();
    let space = |entry: &str| format!("trials = 2\n[search.space]\n{entry}\n");
    for (values, words) in [
        (space("algorithm.bach_size = [64]"), "did you mean `algorithm.batch_size`"),
        (space("dmp.alpha_y = { low = 3, high = 1 }"), "search.space.dmp.alpha_y: low = 3"),
        (space("dmp.alpha_y = { low = 0, high = 1, log = true }"), "more than 0"),
        (space("dmp.alpha_y = [1.0, 'a']"), "one type"),
        (space("exploration.kind = ['pink', 'brown']"), "exploration.kind at \"brown\""),
        (space("algorithm.discount = { low = 0.9, high = 1.5 }"), "algorithm.discount at 1.5"),
        (space("evaluation.first_seed = [1, 2]"), "search.space.evaluation.first_seed"),
        (space("dmp.alpha_y = [9.0]\n[grid]\ndmp.alpha_y = [9.0]"), "[grid] and [search]"),
        (format!("trails = 3\n{}", space("dmp.alpha_y = [9.0]")), "trails"),
    ] {
        let file = write(&place, 300, "[1]", &values);
        place.run(&["sweep", &file]).with_status(2).saying(words).saying("small.toml");
    }
    let file = write(&place, 300, "[1]", &space("dmp.alpha_y = [9.0]"));
    let text = fs::read_to_string(&file).unwrap();
    fs::write(&file, text.replace("[set]", "[set]\nevaluation.first_seed = 1000")).unwrap();
    place.run(&["sweep", &file]).with_status(2).saying("evaluation.first_seed = 1000");
    assert!(!Path::new(&place.path("runs")).exists());
}

#[test]
fn the_example_of_a_search_is_one() {
    let place = Workplace::new();
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/experiments/search-reacher.toml");
    let json = place.run(&["sweep", file, "--dry-run", "--json"]).with_status(0).json();
    assert_eq!(json["search"]["trials"], 30);
    assert_eq!(json["search"]["space"].as_array().unwrap().len(), 4);
}
