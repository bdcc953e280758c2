//! A trained policy drives a robot over the network: docs/examples/robot.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use dmprl_analysis::export;
use dmprl_shared::policy::Hold;
use dmprl_tests::program::{Finished, Running, Workplace, until};
use dmprl_tests::{exported, project_root, venv};
use rustix::process::Signal;
use serde_json::Value;

use crate::train;

const TASK: &str = "panda-reach-joints";
/// Both compute in f32 and sum in different orders.
const TOLERANCE: f64 = 1e-3;
/// Steps after which a test injects its fault.
const DRIVEN: usize = 4;
/// A rate with which the hold takes several steps.
const RATE: &str = "0.25";

fn script(name: &str) -> PathBuf {
    project_root().join("docs/examples/robot").join(name)
}

fn python(script: PathBuf) -> Command {
    let mut command = Command::new(&venv().executable);
    command.arg(script).env("PYTHONPATH", project_root().join("envs_py"));
    command
}

/// A simulated robot with a record of the commands that it executed.
struct Robot {
    process: Running,
    port: String,
    log: String,
}

impl Robot {
    fn start(place: &Workplace, more: &[&str]) -> Self {
        let log = place.path("commands.jsonl");
        let mut command = python(script("stand_in_robot.py"));
        command.args(["dmprl/PandaReachJoints-v0", "--port", "0", "--log", &log]).args(more);
        let mut process = place.start_command(command);
        process.until("a port", |robot| robot.printed().contains('\n'));
        let port = process.printed().trim().rsplit(' ').next().unwrap().to_owned();
        Self { process, port, log }
    }

    /// Returns the commands so far.
    fn commands(&self) -> Vec<Value> {
        let text = fs::read_to_string(&self.log).unwrap_or_default();
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        whole.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    fn until_commands(&self, count: usize) {
        until(&format!("{count} commands"), || self.commands().len() >= count);
    }

    fn last_command(&self) -> Value {
        self.commands().pop().unwrap()
    }
}

/// Starts the driver with 10 steps per second.
fn start_drive(place: &Workplace, policy: &str, robot: &Robot, more: &[&str]) -> Running {
    let mut command = python(script("drive_robot.py"));
    command.args([policy, "--port", &robot.port, "--hz", "10"]).args(more);
    place.start_command(command)
}

/// Drives without a fixed rate and with a long limit, so that no answer is late on a busy machine.
fn drive(place: &Workplace, policy: &str, robot: &Robot, more: &[&str]) -> Finished {
    let mut command = python(script("drive_robot.py"));
    command.args([policy, "--port", &robot.port, "--hz", "0", "--patience", "30"]).args(more);
    place.start_command(command).wait()
}

/// Writes a policy with random parameters, and returns its path.
fn policy(place: &Workplace, hold: Option<Hold>) -> String {
    let mut opened = exported::policy(TASK, &[]);
    opened.hold = hold;
    let path = place.path("random.safetensors");
    fs::write(&path, export::safetensors(&opened).unwrap()).unwrap();
    path
}

/// Fails unless a command is exactly zero in every dimension.
#[track_caller]
fn assert_holds(command: &Value, is_own: bool) {
    let action = command["action"].as_array().unwrap();
    assert!(!action.is_empty() && action.iter().all(|value| *value == 0.0), "{command}");
    assert_eq!(command["is_own"], is_own, "{command}");
}

#[test]
fn a_policy_drives_a_robot_over_the_network_and_holds_when_it_falls_silent() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train(TASK, &run, &["--steps", "1000"])).with_status(0);
    let policy = place.path("panda.safetensors");
    place.run(&["export", &run, "--output", &policy, "--hold", "zero-velocity"]).with_status(0);
    let evaluated = place.run(&["eval", &run, "--episodes", "1", "--json"]).with_status(0).json();

    let answering = Robot::start(&place, &[]);
    let driven = drive(&place, &policy, &answering, &[]).with_status(0).json();
    assert_eq!(driven["steps"], 50);
    assert_eq!(driven["held_steps"].as_array().unwrap().len(), 0, "{driven}");
    // The same episode as in the evaluation.
    let difference = driven["return"].as_f64().unwrap() - evaluated["returns"][0].as_f64().unwrap();
    assert!(difference.abs() < TOLERANCE, "{driven} {evaluated}");
    assert_holds(&answering.last_command(), false);
    drop(answering);

    // Steps 11 to 19 get no answer. The segment decided at step 11 is executed to its end, step 15;
    // then the robot holds until step 20 is answered.
    let silent = Robot::start(&place, &["--silence", "11", "20"]);
    let driven = drive(&place, &policy, &silent, &["--patience", "0.5"]).with_status(0).json();
    assert_eq!(driven["steps"], 50);
    assert_eq!(driven["held_steps"], serde_json::json!([16, 17, 18, 19, 20]), "{driven}");
}

/// With a rate limit, one call of `policy.hold()` stops short of the hold.
#[test]
fn the_last_command_of_a_drive_is_the_hold_also_with_a_rate_limit() {
    let place = Workplace::new();
    let policy = policy(&place, Some(Hold::ZeroVelocity));
    let robot = Robot::start(&place, &[]);
    let driven = drive(&place, &policy, &robot, &["--rate", RATE]).with_status(0).json();
    assert!(driven["hold_steps"].as_u64().unwrap() > 1, "{driven}");
    assert_eq!(driven["hold_answered"], true, "{driven}");
    let commands = robot.commands();
    assert_holds(commands.last().unwrap(), false);
    for pair in commands.windows(2) {
        let value = |command: &Value, d: usize| command["action"][d].as_f64().unwrap();
        for d in 0..commands[0]["action"].as_array().unwrap().len() {
            let change = (value(&pair[1], d) - value(&pair[0], d)).abs();
            assert!(change <= RATE.parse::<f64>().unwrap() + 1e-12, "{pair:?}");
        }
    }
}

#[test]
fn a_policy_without_a_hold_drives_only_with_one_stated() {
    let place = Workplace::new();
    let policy = policy(&place, None);
    let robot = Robot::start(&place, &[]);
    drive(&place, &policy, &robot, &[]).with_status(2).saying("dmprl export --hold");
    drive(&place, &policy, &robot, &["--hold", "position=0"]).with_status(2).saying("7");
    assert_eq!(robot.commands().len(), 0, "nothing has moved");
    drive(&place, &policy, &robot, &["--hold", "zero-velocity"]).with_status(0);
    assert_holds(&robot.last_command(), false);
}

#[test]
fn a_signal_ends_a_drive_with_the_hold() {
    let place = Workplace::new();
    let policy = policy(&place, Some(Hold::ZeroVelocity));
    let robot = Robot::start(&place, &[]);
    for signal in [Signal::TERM, Signal::INT, Signal::HUP] {
        let before = robot.commands().len();
        let driving = start_drive(&place, &policy, &robot, &["--rate", RATE]);
        robot.until_commands(before + DRIVEN);
        driving.signal(signal);
        // A second one does not cut the hold short.
        driving.signal(signal);
        let driven = driving.wait().with_status(128 + signal.as_raw()).json();
        assert_eq!(driven["signal"], signal.as_raw(), "{driven}");
        assert!(driven["steps"].as_u64().unwrap() < 50, "{driven}");
        assert_holds(&robot.last_command(), false);
    }
}

#[test]
fn a_caller_that_freezes_is_noticed_by_the_robot_and_by_itself() {
    let place = Workplace::new();
    let policy = policy(&place, Some(Hold::ZeroVelocity));
    let robot = Robot::start(&place, &["--hold", "zero-velocity", "--timeout", "1"]);
    let driving = start_drive(&place, &policy, &robot, &["--rate", RATE]);
    robot.until_commands(DRIVEN);
    driving.signal(Signal::STOP);
    until("the robot's own hold", || robot.last_command()["is_own"] == true);
    assert_holds(&robot.last_command(), true);
    driving.signal(Signal::CONT);
    let driven = driving.wait().with_status(0).json();
    let frozen = driven["frozen_steps"].as_array().unwrap();
    assert!(!frozen.is_empty(), "{driven}");
    let held = driven["held_steps"].as_array().unwrap();
    assert!(frozen.iter().all(|step| held.contains(step)), "{driven}");
    let commands = robot.commands();
    assert_holds(commands.iter().rfind(|command| command["is_own"] == false).unwrap(), false);
}

#[test]
fn a_robot_that_freezes_is_sent_the_hold_and_reported() {
    let place = Workplace::new();
    let policy = policy(&place, Some(Hold::ZeroVelocity));
    let robot = Robot::start(&place, &["--hold", "zero-velocity"]);
    let driving = start_drive(&place, &policy, &robot, &["--rate", RATE]);
    robot.until_commands(DRIVEN);
    robot.process.signal(Signal::STOP);
    let driven = driving.wait().with_status(1).json();
    assert_eq!(driven["hold_answered"], false, "{driven}");
    let held = driven["held_steps"].as_array().unwrap();
    assert_eq!(held.last().unwrap(), 50, "it holds until the end: {driven}");
    let before = robot.commands().len();
    robot.process.signal(Signal::CONT);
    until("the robot's own hold", || {
        robot.commands().len() > before && robot.last_command()["is_own"] == true
    });
    assert_holds(&robot.last_command(), true);
}

#[test]
fn a_link_that_drops_is_reported_and_the_robot_holds_itself() {
    let place = Workplace::new();
    let policy = policy(&place, Some(Hold::ZeroVelocity));
    let robot = Robot::start(&place, &["--hold", "zero-velocity", "--drop", "8"]);
    let driven = drive(&place, &policy, &robot, &["--rate", RATE]).with_status(1).json();
    assert_eq!((&driven["steps"], &driven["hold_answered"]), (&7.into(), &false.into()));
    assert!(driven["error"].is_string(), "{driven}");
    assert_holds(&robot.last_command(), true);
}
