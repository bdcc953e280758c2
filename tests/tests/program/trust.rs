//! The modules that a run's configuration names are imported only if this user made or trusts it.

use std::fs;
use std::path::Path;
use std::process::Command;

use dmprl_tests::program::{Finished, Workplace, executable};

use crate::train;

/// Leaves a file when it is imported.
const MODULE: &str = "
import pathlib

import gymnasium
import numpy as np
from gymnasium import spaces

pathlib.Path(__file__).with_name('imported').touch()


class Arm(gymnasium.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, render_mode=None):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(size=2), {}

    def step(self, action):
        return self.np_random.uniform(size=2), float(action[0]), False, False, {}


gymnasium.register('Arm-v0', Arm, max_episode_steps=20)
";

/// Runs `dmprl` as a user whose key is in `state`.
fn run_as(place: &Workplace, state: &Path, arguments: &[&str]) -> Finished {
    let mut command = Command::new(executable());
    command.args(arguments).env("XDG_STATE_HOME", state);
    place.start_command(command).wait()
}

#[test]
fn modules_of_anothers_run_are_imported_only_once_it_is_trusted() {
    let place = Workplace::new();
    let (run, modules) = (place.path("run"), place.path("modules"));
    let [owner, stranger] = ["owner", "stranger"].map(|name| place.folder().join(name));
    fs::create_dir(&modules).unwrap();
    fs::write(place.path("modules/arm.py"), MODULE).unwrap();
    let imported = place.folder().join("modules/imported");
    let more = ["--steps", "1000", "--workers", "1", "--python-path", &modules];
    run_as(&place, &owner, &train("arm:Arm-v0", &run, &more)).with_status(0);
    run_as(&place, &owner, &["eval", &run, "--episodes", "1"]).with_status(0);
    assert!(imported.exists());
    fs::remove_file(&imported).unwrap();

    let config = format!("{run}/config.toml");
    let other_run = place.path("other");
    for arguments in [
        &["eval", &run][..],
        &["resume", &run],
        &["record", &run],
        &["play", &run, "--stream"],
        &["train", "arm:Arm-v0", "--config", &config, "--run-dir", &other_run],
    ] {
        let refused = run_as(&place, &stranger, arguments).with_status(2);
        let refused = refused.saying("module arm from ").saying("(outside the run directory)");
        refused.saying("--trust-code");
    }
    let report = ["report", &run, "--output", &place.path("report")];
    run_as(&place, &stranger, &report).with_status(0).saying("--trust-code");
    assert!(!imported.exists(), "it was imported before it was trusted");
    assert!(!Path::new(&other_run).exists());

    run_as(&place, &stranger, &["eval", &run, "--trust-code"]).with_status(0);
    assert!(imported.exists());
    run_as(&place, &stranger, &["eval", &run]).with_status(0);
    // Its configuration now names another folder.
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("/modules\"", "\"")).unwrap();
    run_as(&place, &stranger, &["eval", &run]).with_status(2).saying("installed packages");
}

#[test]
fn without_a_home_directory_training_works_and_later_commands_ask() {
    let place = Workplace::new();
    let (run, modules) = (place.path("run"), place.path("modules"));
    fs::create_dir(&modules).unwrap();
    fs::write(place.path("modules/arm.py"), MODULE).unwrap();
    let nowhere = Path::new("/proc/nowhere");
    let more = ["--steps", "1000", "--workers", "1", "--python-path", &modules];
    let trained = run_as(&place, nowhere, &train("arm:Arm-v0", &run, &more)).with_status(0);
    trained.saying("ask for --trust-code");
    run_as(&place, nowhere, &["eval", &run]).with_status(2).saying("--trust-code");
    run_as(&place, nowhere, &["eval", &run, "--trust-code"]).with_status(0);
}

#[test]
fn a_built_in_task_never_asks() {
    let place = Workplace::new();
    let run = place.path("run");
    let nowhere = Path::new("/proc/nowhere");
    run_as(&place, nowhere, &train("reacher", &run, &["--steps", "1000"])).with_status(0);
    assert!(!Path::new(&run).join("provenance.json").exists());
    run_as(&place, nowhere, &["eval", &run, "--episodes", "1"]).with_status(0);
}
