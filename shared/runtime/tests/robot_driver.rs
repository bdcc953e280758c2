//! Tests of the robot driver in docs/examples/robot, which runs as a process with the robot at the
//! other end of its pipes.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

#[path = "../../../docs/examples/robot/drive_robot.rs"]
#[expect(dead_code, reason = "the test starts `drive` instead of `main`")]
mod drive_robot;

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use dmprl_runtime::config::{AlgorithmName, DmpConfig, PolicyConfig};
use dmprl_runtime::parameters::ParameterSnapshot;
use dmprl_runtime::policy::{Hold, Policy, PolicyDescription};
use dmprl_runtime::spec::EnvSpec;
use dmprl_runtime::{PolicyRuntime, policy_file, seeds};
use rustix::process::{Pid, Signal, kill_process};

const ENTRY: &str = "another_process_drives";
const FILE: &str = "ROBOT_DRIVER_FILE";
const HOLD: [f64; 2] = [0.125, 2.5];
const RATE: f64 = 0.25;
const STEP_S: f64 = 0.02;
/// Limit of every wait for a command, in commands. The driver sends one per control step.
const COMMANDS_MAX: usize = 10_000;

#[test]
fn another_process_drives() {
    let Some(file) = std::env::var_os(FILE) else { return };
    let mut policy = PolicyRuntime::load(Path::new(&file)).unwrap();
    // A failure is an exit status, as of `main`; the harness would print other lines.
    let result = drive_robot::drive(&mut policy, &[RATE; 2], STEP_S);
    std::process::exit(i32::from(result.is_err()));
}

/// A driver, and its robot's end of the pipes.
struct Driver {
    process: Child,
    observations: Option<ChildStdin>,
    commands: Lines<BufReader<ChildStdout>>,
    last: Vec<f64>,
    _folder: tempfile::TempDir,
}

impl Driver {
    fn start(hold: Option<&Hold>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("policy.safetensors");
        std::fs::write(&file, policy(hold)).unwrap();
        let mut process = Command::new(std::env::current_exe().unwrap())
            .args([ENTRY, "--exact", "--nocapture"])
            .env(FILE, &file)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let observations = process.stdin.take();
        let commands = BufReader::new(process.stdout.take().unwrap()).lines();
        Self { process, observations, commands, last: Vec::new(), _folder: folder }
    }

    fn observe(&mut self) {
        let robot = self.observations.as_mut().unwrap();
        robot.write_all(b"0.1 -0.2 0.3 -0.4\n").unwrap();
    }

    /// Receives the next command; `None` at the end.
    fn command(&mut self) -> Option<Vec<f64>> {
        for line in self.commands.by_ref().take(COMMANDS_MAX) {
            let line = line.unwrap();
            // Lines of the test harness are not numbers.
            let numbers: Result<Vec<f64>, _> = line.split(' ').map(str::parse).collect();
            let Ok(command) = numbers else { continue };
            if !self.last.is_empty() {
                for (value, before) in command.iter().zip(&self.last) {
                    assert!((value - before).abs() <= RATE + 1e-12, "{before} {value}");
                }
            }
            self.last.clone_from(&command);
            return Some(command);
        }
        None
    }

    /// Lets the robot answer each command until one is far from the hold.
    fn drive_away(&mut self) {
        for _ in 0..COMMANDS_MAX {
            self.observe();
            let command = self.command().unwrap();
            if command.iter().zip(HOLD).any(|(value, hold)| (value - hold).abs() > 2.0 * RATE) {
                return;
            }
        }
        panic!("the policy does not leave the hold, so this test shows nothing");
    }

    fn signal(&self, signal: Signal) {
        let id = Pid::from_raw(i32::try_from(self.process.id()).unwrap()).unwrap();
        kill_process(id, signal).unwrap();
    }

    /// Checks that the last command is the hold, and returns the exit status.
    fn assert_ends_with_the_hold(&mut self) -> Option<i32> {
        let mut count = 0;
        while self.command().is_some() {
            count += 1;
        }
        assert!(count > 1, "one command cannot reach the hold");
        assert_eq!(self.last, HOLD);
        self.process.wait().unwrap().code()
    }
}

impl Drop for Driver {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Encodes a policy with large parameters, so that its actions are far from each other.
fn policy(hold: Option<&Hold>) -> Vec<u8> {
    let spec = EnvSpec::new("Test-v0", 4, &[(-10.0, 10.0), (-10.0, 10.0)], STEP_S, 50);
    let description = PolicyDescription {
        spec,
        algorithm: AlgorithmName::Td3,
        policy: PolicyConfig::default(),
        dmp: DmpConfig::default(),
        start_sources: Vec::new(),
        task_options: None,
    };
    let policy = Policy::new(description).unwrap();
    let mut values = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
    values.iter_mut().for_each(|value| *value *= 5.0);
    let architecture_hash = policy.architecture_hash();
    let snapshot =
        ParameterSnapshot { version: 1, env_steps: 0, architecture_hash, settled: false, values };
    policy_file::encode(&policy, &snapshot, None, hold).unwrap()
}

fn hold() -> Hold {
    Hold::Position { values: HOLD.to_vec() }
}

#[test]
fn signal_ends_a_drive_with_the_hold() {
    for signal in [Signal::TERM, Signal::INT, Signal::HUP] {
        let mut driver = Driver::start(Some(&hold()));
        driver.drive_away();
        driver.signal(signal);
        assert_eq!(driver.assert_ends_with_the_hold(), Some(0), "{signal:?}");
    }
}

#[test]
fn robot_that_freezes_is_sent_the_hold() {
    let mut driver = Driver::start(Some(&hold()));
    driver.drive_away();
    // No more observations.
    for _ in 0..COMMANDS_MAX {
        if driver.command().unwrap() == HOLD {
            driver.signal(Signal::TERM);
            return;
        }
    }
    panic!("never held");
}

#[test]
fn robot_that_hangs_up_is_sent_the_hold_and_reported() {
    let mut driver = Driver::start(Some(&hold()));
    driver.drive_away();
    driver.observations = None;
    assert_eq!(driver.assert_ends_with_the_hold(), Some(1));
}

#[test]
fn policy_without_a_hold_does_not_begin_to_drive() {
    let mut driver = Driver::start(None);
    assert_eq!(driver.command(), None);
    assert_eq!(driver.process.wait().unwrap().code(), Some(1));
}
