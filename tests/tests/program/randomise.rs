//! `task.randomise`, from the command line to every reader of a run.

use std::fs;

use dmprl_tests::program::{Workplace, rows};
use serde_json::{Value, json};

use crate::{SMALL, train};

/// Each step's reward is the action that takes effect; an episode has 10 steps.
const ECHO: &str = "
import gymnasium
import numpy as np
from gymnasium import spaces


class Echo(gymnasium.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(1.0, 2.0, (1,), np.float64)
    max_episode_steps = 10

    def __init__(self, render_mode=None):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2), {}

    def step(self, action):
        return np.zeros(2), float(action[0] == 1.0), False, False, {}
";

fn returns(row: &Value) -> &Value {
    &row["returns"]
}

#[test]
fn delays_are_those_of_training_evaluation_and_resume_and_eval_sets_others() {
    let place = Workplace::new();
    fs::write(place.path("echo.py"), ECHO).unwrap();
    let (run, folder) = (place.path("run"), place.path(""));
    let ranges = ["--set", "task.randomise.action_delay_steps=[10, 10]"];
    let more = ["--python-path", &folder, "--workers", "1", "--steps", "1000"];
    place.run(&train("echo:Echo", &run, &[&more[..], &ranges].concat())).with_status(0);
    // No action of an episode takes effect in it; the idle action is the nearest to zero, 1.
    let idle = json!([10.0, 10.0, 10.0, 10.0]);
    assert_eq!(*returns(rows(&run, "evaluations.jsonl").last().unwrap()), idle);
    let row = place.run(&["eval", &run, "--json"]).with_status(0).json();
    assert_eq!((returns(&row), &row["randomise"]), (&idle, &Value::Null));

    let set = ["--set", "task.randomise.action_delay_steps=[0, 0]"];
    let row = place.run(&[&["eval", &run, "--json"][..], &set].concat()).with_status(0).json();
    assert_ne!(*returns(&row), idle);
    assert_eq!(row["randomise"]["action_delay_steps"], json!([0, 0]));

    place.run(&["resume", &run, "--steps", "2000"]).with_status(0);
    assert_eq!(rows(&run, "metrics.jsonl").pop().unwrap()["env_steps"], 2000);
    assert_eq!(*returns(rows(&run, "evaluations.jsonl").last().unwrap()), idle);

    for (pair, words) in [
        ("algorithm.batch_size=8", "expected task.randomise.KEY=[LOW, HIGH]"),
        ("task.randomise.mass", "expected task.randomise.KEY=[LOW, HIGH]"),
        ("task.randomise.mass=[2.0, 1.0]", "low <= high"),
        ("task.randomise.masses=[1.0, 2.0]", "did you mean `task.randomise.mass`"),
    ] {
        place.run(&["eval", &run, "--set", pair]).with_status(2).saying(words);
    }
    let set = ["eval", &run, "--set", "task.randomise.mass=[0.5, 2.0]"];
    place.run(&set).with_status(1).saying("task.randomise.mass cannot be applied to echo:Echo");
    place.assert_no_process();
}

#[test]
fn what_a_task_lacks_is_refused_with_the_key() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = ["--workers", "1", "--set", "task.randomise.object_size=[0.8, 1.2]"];
    let refused = place.run(&train("panda-reach", &run, &more)).with_status(1);
    refused.saying("task.randomise.object_size cannot be applied to dmprl/PandaReach-v0");
    place.assert_no_process();
}

#[test]
fn a_sweep_varies_a_range() {
    let place = Workplace::new();
    let file = place.path("small.toml");
    let settings = SMALL.join("\n");
    fs::write(
        &file,
        format!(
            "seeds = [1]\n[[task]]\nname = 'reacher'\nsteps = 1000\n[grid]\n\
             task.randomise.mass = [[1.0, 1.0], [20.0, 20.0]]\n[set]\n{settings}"
        ),
    )
    .unwrap();
    let json = place.run(&["sweep", &file, "--json"]).with_status(0).json();
    let runs = json["runs"].as_array().unwrap();
    let text = |run: &Value| {
        fs::read_to_string(format!("{}/config.toml", run["run"].as_str().unwrap())).unwrap()
    };
    assert!(text(&runs[0]).contains("mass = [1.0, 1.0]"), "{}", text(&runs[0]));
    assert!(text(&runs[1]).contains("mass = [20.0, 20.0]"), "{}", text(&runs[1]));
}
