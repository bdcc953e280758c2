//! `dmprl sweep` with short real runs.

use std::fs;

use dmprl_tests::program::{Workplace, env_steps_of_checkpoint, json_file, rows};
use rustix::process::Signal;
use serde_json::Value;

use crate::SMALL;

fn write(place: &Workplace, text: &str) -> String {
    let file = place.path("small.toml");
    fs::write(&file, format!("{text}\n[set]\n{}", SMALL.join("\n"))).unwrap();
    file
}

fn states(json: &Value) -> Vec<(String, u64)> {
    let runs = json["runs"].as_array().unwrap().iter();
    let state = |run: &Value| run["state"].as_str().unwrap().to_owned();
    runs.map(|run| (state(run), run["env_steps"].as_u64().unwrap())).collect()
}

fn evaluations(json: &Value) -> Vec<usize> {
    let runs = json["runs"].as_array().unwrap().iter();
    runs.map(|run| rows(run["run"].as_str().unwrap(), "evaluations.jsonl").len()).collect()
}

fn sessions(json: &Value, run: usize) -> usize {
    let path = json["runs"][run]["run"].as_str().unwrap();
    json_file(path, "manifest.json")["sessions"].as_array().unwrap().len()
}

const TWO_METHODS: &str = "
    seeds = [1, 2]
    [[task]]
    name = 'reacher'
    steps = 300
    [[method]]
    name = 'dmp'
    [[method]]
    name = 'mlp'
    label = 'TD3'
    policy = 'mlp'
";

#[test]
fn every_run_of_a_sweep_is_trained_once_and_a_longer_one_goes_on() {
    let place = Workplace::new();
    let file = write(&place, TWO_METHODS);
    let listed = place.run(&["sweep", &file, "--dry-run", "--json"]).with_status(0).json();
    assert_eq!(states(&listed), vec![("open".to_owned(), 0); 4]);
    assert!(!std::path::Path::new(&place.path("runs")).exists(), "a dry run makes nothing");

    // A kill or a full disk interrupted the making of a run directory.
    let unfinished = place.path("runs/small/reacher/dmp/seed-1");
    fs::create_dir_all(format!("{unfinished}/logs")).unwrap();
    let json = place.run(&["sweep", &file, "--jobs", "2", "--json"]).with_status(0).json();
    assert_eq!(states(&json), vec![("finished".to_owned(), 300); 4]);
    assert!(std::path::Path::new(&format!("{unfinished}.unfinished-0/logs")).is_dir());
    assert_eq!(json["runs"][1]["method"], "TD3");
    assert!(json["runs"][3]["run"].as_str().unwrap().ends_with("runs/small/reacher/mlp/seed-2"));
    assert!(evaluations(&json).iter().all(|&rows| rows > 0));

    let again = place.run(&["sweep", &file, "--json"]).with_status(0).json();
    assert_eq!(states(&again), states(&json));
    assert_eq!(sessions(&again, 0), 1, "a finished run is not repeated");

    // With more steps, each run continues. With another configuration, the sweep is refused and
    // nothing changes.
    let longer = write(&place, &TWO_METHODS.replace("300", "400"));
    let json = place.run(&["sweep", &longer, "--json"]).with_status(0).json();
    assert_eq!(states(&json), vec![("finished".to_owned(), 400); 4]);
    assert_eq!(sessions(&json, 0), 2);
    let other = write(&place, &TWO_METHODS.replace("'dmp'", "'dmp'\nset = { dmp.alpha_y = 9.0 }"));
    let refused = place.run(&["sweep", &other]).with_status(1);
    refused.saying("dmp.alpha_y").saying("another configuration");
    let kept = fs::read_to_string(place.path("runs/small/sweep.toml")).unwrap();
    assert!(!kept.contains("alpha_y"), "the folder belongs to the earlier file");
    place.assert_no_process();
}

#[test]
fn a_sweep_that_is_interrupted_or_killed_goes_on_where_it_was() {
    let place = Workplace::new();
    let file = write(&place, &TWO_METHODS.replace("300", "12000").replace("[1, 2]", "[1]"));
    for signal in [Signal::INT, Signal::KILL] {
        let mut running = place.start(&["sweep", &file, "--jobs", "1", "--json"]);
        let run = place.path("runs/small/reacher/dmp/seed-1");
        let before = env_steps_of_checkpoint(&run).unwrap_or(0);
        running.until("a checkpoint", |_| {
            env_steps_of_checkpoint(&run).is_some_and(|steps| steps > before)
        });
        running.signal(signal);
        let finished = running.wait();
        if signal == Signal::INT {
            let finished = finished.with_status(130).saying("resume with: dmprl sweep");
            let (state, env_steps) = states(&finished.json()).swap_remove(0);
            assert!(state == "open" && env_steps > before, "{state} at {env_steps}");
        }
        place.until_no_process();
    }
    let json = place.run(&["sweep", &file, "--jobs", "2", "--json"]).with_status(0).json();
    assert_eq!(states(&json), vec![("finished".to_owned(), 12_000); 2]);
    assert_eq!(sessions(&json, 0), 3);
}

#[test]
fn a_run_that_fails_costs_the_others_nothing_and_is_tried_again() {
    let place = Workplace::new();
    let module = place.path("flaky_arm.py");
    fs::write(&module, "raise RuntimeError('no arm here')\n").unwrap();
    let folder = place.path("");
    let file = write(
        &place,
        &format!(
            "seeds = [1]\n[[task]]\nname = 'flaky_arm:Arm-v0'\nsteps = 300\n\
             set = {{ task.python_path = ['{folder}'] }}\n[[task]]\nname = 'reacher'\nsteps = 300\n"
        ),
    );
    let finished = place.run(&["sweep", &file, "--json"]).with_status(1);
    let finished = finished.saying("a run failed").saying("no arm here");
    let json = finished.json();
    assert_eq!(states(&json), [("failed".to_owned(), 0), ("finished".to_owned(), 300)]);
    assert!(json["runs"][0]["reason"].as_str().unwrap().contains("no arm here"));
    let again = place.run(&["sweep", &file]).with_status(1);
    again.saying("a run failed");
}

#[test]
fn the_sweeps_behind_the_published_results_can_be_started() {
    let place = Workplace::new();
    let folder = dmprl_tests::project_root().join("deploy/experiments");
    // Tasks × methods × seeds. A code block of docs/results.md runs the one with demonstrations,
    // which needs their file.
    for (name, runs) in [("paper", 5 * 11 * 5), ("defaults", 5 * 3), ("algorithms", 4 * 3)] {
        let file = folder.join(format!("{name}.toml")).display().to_string();
        let json = place.run(&["sweep", &file, "--dry-run", "--json"]).with_status(0).json();
        assert_eq!(states(&json).len(), runs, "{name}");
    }
}

#[test]
fn a_mistake_in_the_file_is_told_before_anything_starts() {
    let place = Workplace::new();
    for (text, words) in [
        ("seeds = [1]\n[[task]]\nname = 'reachr'\n", "did you mean `reacher`"),
        ("seeds = [1]\n[[task]]\nname = 'reacher'\nset = { dmp.alpha = 1 }\n", "dmp.alpha"),
        ("seeds = [1]\n[[task]]\nname = 'reacher'\n[[method]]\nname = 'x'\nalgo = 'ppo'", "ppo"),
        ("seeds = [1]\n", "task"),
    ] {
        let file = write(&place, text);
        place.run(&["sweep", &file]).with_status(2).saying(words);
    }
    place.run(&["sweep", "none.toml"]).with_status(2).saying("none.toml");
    assert!(!std::path::Path::new(&place.path("runs")).exists());
}
