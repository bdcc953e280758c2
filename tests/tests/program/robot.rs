//! A trained policy drives a robot over the network: docs/examples/robot.

use std::path::PathBuf;
use std::process::Command;

use dmprl_tests::program::{Running, Workplace};
use dmprl_tests::{project_root, venv};

use crate::train;

const TASK: &str = "panda-reach-joints";
/// Both compute in f32 and sum in different orders.
const TOLERANCE: f64 = 1e-3;

fn script(name: &str) -> PathBuf {
    project_root().join("docs/examples/robot").join(name)
}

fn python(script: PathBuf) -> Command {
    let mut command = Command::new(&venv().executable);
    command.arg(script).env("PYTHONPATH", project_root().join("envs_py"));
    command
}

/// Starts a simulated robot and returns its port.
fn robot(place: &Workplace, more: &[&str]) -> (Running, String) {
    let mut command = python(script("stand_in_robot.py"));
    command.args(["dmprl/PandaReachJoints-v0", "--port", "0"]).args(more);
    let mut robot = place.start_command(command);
    robot.until("a port", |robot| robot.printed().contains('\n'));
    let port = robot.printed().trim().rsplit(' ').next().unwrap().to_owned();
    (robot, port)
}

#[test]
fn a_policy_drives_a_robot_over_the_network_and_holds_when_it_falls_silent() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train(TASK, &run, &["--steps", "1000"])).with_status(0);
    let policy = place.path("panda.safetensors");
    place.run(&["export", &run, "--output", &policy]).with_status(0);
    let evaluated = place.run(&["eval", &run, "--episodes", "1", "--json"]).with_status(0).json();

    let (answering, port) = robot(&place, &[]);
    // Without a fixed rate and with a long limit, so that no answer is late on a busy machine.
    let drive = |port: &str, patience: &str| {
        let mut command = python(script("drive_robot.py"));
        command.args([&policy, "--port", port, "--hz", "0", "--patience", patience]);
        place.start_command(command).wait().with_status(0).json()
    };
    let driven = drive(&port, "30");
    assert_eq!(driven["steps"], 50);
    assert_eq!(driven["held_steps"].as_array().unwrap().len(), 0, "{driven}");
    // The same episode as in the evaluation.
    let difference = driven["return"].as_f64().unwrap() - evaluated["returns"][0].as_f64().unwrap();
    assert!(difference.abs() < TOLERANCE, "{driven} {evaluated}");
    drop(answering);

    // Steps 11 to 19 get no answer. The segment decided at step 11 is executed to its end, step 15;
    // then the robot holds until step 20 is answered.
    let (_silent, port) = robot(&place, &["--silence", "11", "20"]);
    let driven = drive(&port, "0.5");
    assert_eq!(driven["steps"], 50);
    assert_eq!(driven["held_steps"], serde_json::json!([16, 17, 18, 19, 20]), "{driven}");
}
