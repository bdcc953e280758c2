//! Arguments and wrappers of the environment, from the command line to every reader of a run.

use std::fs;

use dmprl_tests::program::{Workplace, json_file, rows, shared_memory_of};
use serde_json::Value;

use crate::{SMALL, train};

/// Each step's reward is the argument `gain`, so that a return shows it.
const PLAIN: &str = "
import gymnasium
import numpy as np
from gymnasium import spaces


class Plain(gymnasium.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    max_episode_steps = 20

    def __init__(self, gain=1.0, render_mode=None):
        if gain < 0:
            raise ValueError(f'gain is {gain}; expected 0 or more')
        self.gain = gain

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(size=2), {}

    def step(self, action):
        return self.np_random.uniform(size=2), self.gain, False, False, {}


def doubled(env):
    return gymnasium.wrappers.TransformReward(env, lambda reward: 2.0 * reward)
";

fn workplace() -> Workplace {
    let place = Workplace::new();
    fs::write(place.path("plain.py"), PLAIN).unwrap();
    place
}

fn returns(row: &Value) -> Vec<f64> {
    row["returns"].as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
}

fn last_returns(run: &str) -> Vec<f64> {
    returns(rows(run, "evaluations.jsonl").last().unwrap())
}

#[test]
fn the_module_of_a_project_in_the_current_folder_needs_no_python_path() {
    let place = Workplace::new();
    fs::create_dir_all(place.path("src/lab")).unwrap();
    fs::write(place.path("src/lab/plain.py"), PLAIN).unwrap();
    fs::write(place.path("pyproject.toml"), "[project]\nname = 'lab'\n").unwrap();
    let run = place.path("run");
    place
        .run(&train("lab.plain:Plain", &run, &["--steps", "400"]))
        .with_status(0)
        .saying(&format!("modules from {}", place.path("src")));
    assert_eq!(last_returns(&run), [20.0; 4]);
}

#[test]
fn arguments_and_wrappers_are_those_of_training_evaluation_and_resume() {
    let place = workplace();
    let (run, folder) = (place.path("run"), place.path(""));
    let more = ["--python-path", &folder, "--workers", "1", "--steps", "1000"];
    let kwargs = ["--env-kwargs", "gain=1.5", "--env-kwargs", "max_episode_steps=10"];
    let wrappers = ["--set", "task.wrappers=[\"plain:doubled\"]"];
    let more = [&more[..], &kwargs, &wrappers].concat();
    place.run(&train("plain:Plain", &run, &more)).with_status(0);
    // 10 steps with a reward of 1.5, doubled.
    assert_eq!(last_returns(&run), [30.0; 4]);
    assert_eq!(json_file(&run, "spec.json")["episode_steps"], 10);
    let training = &rows(&run, "metrics.jsonl").pop().unwrap()["training_return_mean"];
    assert_eq!(*training, 30.0);

    let row = place.run(&["eval", &run, "--json"]).with_status(0).json();
    assert_eq!(returns(&row), [30.0; 4]);
    place.run(&["resume", &run, "--steps", "2000"]).with_status(0);
    assert_eq!(rows(&run, "metrics.jsonl").pop().unwrap()["env_steps"], 2000);
    assert_eq!(last_returns(&run), [30.0; 4]);

    // With other arguments it is another environment, whose checkpoints are not those of this run.
    let file = place.path("run/config.toml");
    let text = fs::read_to_string(&file).unwrap();
    assert!(text.contains("gain = 1.5"), "{text}");
    fs::write(&file, text.replace("gain = 1.5", "gain = 2.5")).unwrap();
    // The arguments are no longer those that the user gave.
    let resume = ["resume", &run, "--steps", "3000"];
    place.run(&resume).with_status(2).saying("gain = 2.5").saying("--trust-code");
    let refused = place.run(&[&resume[..], &["--trust-code"]].concat()).with_status(1);
    refused.saying("expected").saying("from the configuration").saying("task.kwargs");
    place.run(&["eval", &run]).with_status(1).saying("architecture");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new());
}

#[test]
fn a_wrong_argument_is_refused_with_the_environments_message_and_a_remedy() {
    let place = workplace();
    let folder = place.path("");
    for (index, (task, settings, words)) in [
        (
            "plain:Plain",
            &["--env-kwargs", "gian=2"][..],
            &["unexpected keyword argument 'gian'", "change task.kwargs (--env-kwargs)"][..],
        ),
        (
            "plain:Plain",
            &["--env-kwargs", "gain=-1"],
            &["ValueError: gain is -1; expected 0 or more", "change task.kwargs (--env-kwargs)"],
        ),
        (
            "plain:Plain",
            &["--set", "task.wrappers=[\"plain:tripled\"]"],
            &["the module plain has no class or function tripled", "change task.wrappers"],
        ),
        (
            "panda-reach",
            &["--env-kwargs", "reward_type=sparse"],
            &["dmprl/PandaReach-v0 has no argument reward_type; expected max_episode_steps"],
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let run = place.path(&format!("run-{index}"));
        let more = [&["--python-path", &folder, "--workers", "1"], settings].concat();
        let finished = place.run(&train(task, &run, &more)).with_status(1);
        assert!(words.iter().all(|word| finished.said.contains(word)), "{}", finished.said);
        place.assert_no_process();
    }
}

#[test]
fn a_sweep_varies_an_argument() {
    let place = workplace();
    let (file, folder) = (place.path("small.toml"), place.path(""));
    let settings = SMALL.join("\n");
    fs::write(
        &file,
        format!(
            "seeds = [1]\n[[task]]\nname = 'plain:Plain'\nsteps = 1000\n\
             [task.set.task]\npython_path = ['{folder}']\nkwargs.max_episode_steps = 10\n\
             [grid]\ntask.kwargs.gain = [1.0, 2.0]\n[set]\n{settings}"
        ),
    )
    .unwrap();
    let json = place.run(&["sweep", &file, "--json"]).with_status(0).json();
    let runs = json["runs"].as_array().unwrap();
    let returns = runs.iter().map(|run| last_returns(run["run"].as_str().unwrap())[0]);
    assert_eq!(returns.collect::<Vec<_>>(), [10.0, 20.0]);

    // The runs belong to the arguments of this file.
    let text = fs::read_to_string(&file).unwrap();
    fs::write(&file, text.replace("max_episode_steps = 10", "max_episode_steps = 9")).unwrap();
    let refused = place.run(&["sweep", &file]).with_status(1);
    refused.saying("task.kwargs.max_episode_steps is 10 there and 9 in the sweep");
}
