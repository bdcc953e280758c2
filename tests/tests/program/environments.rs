//! Environments that fail in every life are named, recreated, and restart their worker within
//! limits. Their segments never enter the replay.

use std::fs;

use dmprl_tests::program::{Finished, Workplace, json_file, rows, shared_memory_of};

use crate::train;

/// Each environment fails in step 23 of its life: in its fifth segment, after four complete ones.
const FAULTY: &str = "
import os

import gymnasium
import numpy as np
from gymnasium import spaces


class Faulty(gymnasium.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, fault, render_mode=None):
        self.fault, self.life = fault, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(size=2), {}

    def step(self, action):
        self.life += 1
        observation, reward = self.np_random.uniform(size=2), float(action[0])
        if self.life == 23:
            if self.fault == 'raise':
                raise ValueError('the gripper fell off')
            if self.fault == 'observation':
                observation[1] = np.nan
            if self.fault == 'reward':
                reward = np.inf
            if self.fault == 'exit':
                os._exit(7)
        if self.fault == 'chatter':
            print('{\"progress\": 1}', flush=True)
            os.write(1, b'\"learner_ready\"\\n')
        return observation, reward, False, False, {}


for fault in ('raise', 'observation', 'reward', 'exit', 'chatter'):
    gymnasium.register(f'{fault.title()}-v0', Faulty, kwargs={'fault': fault}, max_episode_steps=50)
";

const ENVS: u64 = 3;
const WHOLE_STEPS: u64 = 20;

fn train_faulty(place: &Workplace, id: &str, more: &[&str]) -> (String, Finished) {
    fs::write(place.path("faulty.py"), FAULTY).unwrap();
    let (run, folder) = (place.path("run"), place.path(""));
    let envs = ENVS.to_string();
    let common = ["--python-path", &folder, "--workers", "1", "--envs-per-worker", &envs];
    let more = [&common[..], &["--steps", "1000"], more].concat();
    let finished = place.run(&train(id, &run, &more));
    (run, finished)
}

/// One restart is allowed, so two lives of a worker contribute to the replay: the complete segments
/// of `lives` lives of their environments.
fn breaks(id: &str, lives: u64, words: &[&str]) {
    let place = Workplace::new();
    let restarts = ["--set", "actors.restarts_max=1", "--set", "actors.env_failures_max=1"];
    let (run, finished) = train_faulty(&place, id, &restarts);
    let finished = finished
        .with_status(1)
        .saying("restart 1 of 1")
        .saying("no worker is left")
        .saying("actor-0.log");
    for words in words {
        assert!(finished.said.contains(words), "no `{words}`:\n{}", finished.said);
    }
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new());
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(last["env_steps"], lives * ENVS * WHOLE_STEPS, "{last}");
    assert!(last["rejected"].as_object().unwrap().values().all(|count| count == 0), "{last}");
    let state = json_file(&run, "checkpoints/latest/state.json");
    assert_eq!(state["counters"]["env_steps"], lives * ENVS * WHOLE_STEPS);
}

#[test]
fn an_environment_that_raises_is_named_with_its_step() {
    let words = ["faulty:Raise-v0", "step 2 ", "ValueError: the gripper fell off"];
    breaks("faulty:Raise-v0", 4, &words);
}

#[test]
fn an_observation_that_is_nan_is_named_and_never_learnt_from() {
    breaks("faulty:Observation-v0", 4, &["faulty:Observation-v0", "step 2", "observation", "nan"]);
}

#[test]
fn a_reward_that_is_infinite_is_named_and_never_learnt_from() {
    breaks("faulty:Reward-v0", 4, &["faulty:Reward-v0", "step 2", "reward", "inf"]);
}

#[test]
fn an_environment_that_ends_its_process_is_restarted_and_then_given_up() {
    breaks("faulty:Exit-v0", 2, &["exit status 7"]);
}

#[test]
fn what_an_environment_prints_is_in_the_log_and_disturbs_nobody() {
    let place = Workplace::new();
    let (run, finished) = train_faulty(&place, "faulty:Chatter-v0", &[]);
    let finished = finished.with_status(0);
    assert!(!finished.said.contains("not a report"), "{}", finished.said);
    let log = fs::read_to_string(place.path("run/logs/actor-0.log")).unwrap();
    assert!(log.contains("learner_ready") && log.contains("progress"));
    assert_eq!(rows(&run, "metrics.jsonl").pop().unwrap()["env_steps"], 1000);
}

#[test]
fn an_environment_that_is_not_there_is_refused_with_a_suggestion() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("Pendulm-v1", &run, &[])).with_status(1).saying("Did you mean: `Pendulum`");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new());
}

/// Each environment is in a process of its own, and episodes of 8 steps end within segments.
const VECTOR: &str = "
import gymnasium
import numpy as np
from gymnasium import spaces


class Still(gymnasium.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.uniform(size=2), {}

    def step(self, action):
        self.steps += 1
        truncated = self.steps == 8
        return self.np_random.uniform(size=2), 0.5, False, truncated, {'is_success': truncated}


def many(num_envs):
    return gymnasium.vector.AsyncVectorEnv([Still] * num_envs)
";

#[test]
fn a_vector_environment_trains_and_leaves_no_process() {
    let place = Workplace::new();
    fs::write(place.path("vector.py"), VECTOR).unwrap();
    let (run, folder) = (place.path("run"), place.path(""));
    let more = ["--python-path", &folder, "--workers", "1", "--envs-per-worker", "3"];
    let more = [&more[..], &["--steps", "600"]].concat();
    place.run(&train("vector:many", &run, &more)).with_status(0);
    place.until_no_process();
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(last["env_steps"], 600);
    assert_eq!((&last["training_return_mean"], &last["env_failures"]), (&4.0.into(), &0.into()));
    let evaluation = rows(&run, "evaluations.jsonl").pop().unwrap();
    assert_eq!(evaluation["returns"], serde_json::json!([4.0, 4.0, 4.0, 4.0]));
    assert_eq!(evaluation["success_rate"], 1.0);
    place.run(&["eval", &run, "--episodes", "3"]).with_status(0);
    place
        .run(&["play", &run])
        .with_status(1)
        .saying("vector:many is a vector environment, which cannot be shown");
    place
        .run(&["record", &run])
        .with_status(1)
        .saying("vector:many is a vector environment, which cannot be drawn");
}
