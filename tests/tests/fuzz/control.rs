//! The control protocol: arbitrary lines, and lines without an end.

use std::io::{Cursor, Read};
use std::sync::mpsc;
use std::time::Duration;

use dmprl_control::ControlPipe;
use dmprl_control::{
    Activity, Command, EvaluationRequest, Greeting, JoinAnswer, JoinRequest, Progress, Report,
    Welcome, WorkersNow,
};
use serde_json::Value;

use crate::mutate::{self, Random};
use crate::{Target, Verdict, fixture};

/// Limit for the pipe's thread on any machine.
const PATIENCE: Duration = Duration::from_secs(30);

fn request() -> EvaluationRequest {
    EvaluationRequest { env_steps: 1, updates: 2, segments: 3, wall_s: 4.5, policy_version: 6 }
}

fn commands() -> Vec<Value> {
    let commands = [
        Command::Attach { domain: "/dev/shm/x".into() },
        Command::Evaluate(request()),
        Command::EnvFailures { total: 3 },
        Command::Sent(Default::default()),
        Command::Workers(WorkersNow { count: 2, restarts: 1, queued_segments: 9 }),
        Command::Finish,
        Command::Stop,
    ];
    commands.iter().map(|command| serde_json::to_value(command).unwrap()).collect()
}

fn reports() -> Vec<Value> {
    let reports = [
        Report::EnvironmentReady { spec: fixture::spec() },
        Report::Progress(Progress::default()),
        Report::Evaluate(request()),
        Report::EnvFailures { count: 1, last: "why".into() },
        Report::Checkpoint { name: "000001".into(), env_steps: 5 },
        Report::Alive { doing: Activity::Waiting, kept: 8 },
        Report::Finished,
    ];
    reports.iter().map(|report| serde_json::to_value(report).unwrap()).collect()
}

/// A line that is almost one of `valid`.
fn line(random: &mut Random, valid: &[Value]) -> Vec<u8> {
    let mut tree = random.pick(valid).clone();
    let other = serde_json::to_vec(random.pick(valid)).unwrap();
    if !random.once_in(3) {
        mutate::json(random, &mut tree);
    }
    let mut line = serde_json::to_vec(&tree).unwrap();
    if random.once_in(4) {
        mutate::bytes(random, &mut line, &other);
    }
    if random.once_in(200) {
        line = b"[".repeat(random.below(2 << 20));
    }
    line.retain(|&byte| byte != b'\n');
    line
}

#[test]
fn a_report_that_is_accepted_is_the_same_when_written_and_read() {
    let target = Target {
        name: "control::a_report_that_is_accepted_is_the_same_when_written_and_read",
        cases: 10_000,
        bytes_max: 16 << 20,
    };
    let valid = reports();
    target.fuzz(|random| {
        let read = serde_json::from_slice::<Report>(&line(random, &valid));
        if let Ok(report) = &read {
            let written = serde_json::to_vec(report).unwrap();
            assert_eq!(serde_json::from_slice::<Report>(&written).unwrap(), *report);
        }
        Verdict::of(&read)
    });
}

#[test]
fn a_command_that_is_accepted_is_the_same_when_written_and_read() {
    let target = Target {
        name: "control::a_command_that_is_accepted_is_the_same_when_written_and_read",
        cases: 10_000,
        bytes_max: 16 << 20,
    };
    let valid = commands();
    target.fuzz(|random| {
        let read = serde_json::from_slice::<Command>(&line(random, &valid));
        if let Ok(command) = &read {
            let written = serde_json::to_vec(command).unwrap();
            assert_eq!(serde_json::from_slice::<Command>(&written).unwrap(), *command);
        }
        Verdict::of(&read)
    });
}

/// Messages between joining workers and supervisors before the worker is accepted.
#[test]
fn a_word_of_joining_that_is_accepted_is_the_same_when_written_and_read() {
    let target = Target {
        name: "control::a_word_of_joining_that_is_accepted_is_the_same_when_written_and_read",
        cases: 10_000,
        bytes_max: 16 << 20,
    };
    let welcome = Welcome { index: 1, incarnation: 2, venv: Some("/v".into()), workers: 3 };
    let refused = JoinAnswer::Refused { reason: "full".into() };
    let requests = [serde_json::to_value(JoinRequest { speaks: Greeting::this() }).unwrap()];
    let answers = [JoinAnswer::Welcome(welcome), refused];
    let answers = answers.map(|answer| serde_json::to_value(answer).unwrap());
    target.fuzz(|random| {
        if random.once_in(2) {
            let read = serde_json::from_slice::<JoinRequest>(&line(random, &requests));
            if let Ok(request) = &read {
                let written = serde_json::to_vec(request).unwrap();
                assert_eq!(serde_json::from_slice::<JoinRequest>(&written).unwrap(), *request);
            }
            return Verdict::of(&read);
        }
        let read = serde_json::from_slice::<JoinAnswer>(&line(random, &answers));
        if let Ok(answer) = &read {
            let written = serde_json::to_vec(answer).unwrap();
            assert_eq!(serde_json::from_slice::<JoinAnswer>(&written).unwrap(), *answer);
        }
        Verdict::of(&read)
    });
}

/// A role receives valid commands in order among invalid lines, and detects the end.
#[test]
fn commands_come_through_between_lines_that_are_none() {
    let target = Target {
        name: "control::commands_come_through_between_lines_that_are_none",
        // Few, because the role reports each invalid line.
        cases: 12,
        bytes_max: 16 << 20,
    };
    let valid = commands();
    target.fuzz(|random| {
        let mut input = Vec::new();
        let mut expected = Vec::new();
        let lines = 1 + random.below(8);
        for _ in 0..lines {
            let valid_line = || serde_json::to_vec(&valid[0]).unwrap();
            let line = if random.once_in(4) { line(random, &valid) } else { valid_line() };
            let too_long = line.len() >= 1 << 20;
            if let Ok(command) = serde_json::from_slice::<Command>(&line)
                && matches!(command, Command::Attach { .. } | Command::Evaluate(_))
            {
                expected.push(command);
            }
            input.extend(line);
            input.push(b'\n');
            if too_long {
                // The supervisor is gone.
                break;
            }
        }
        let (sender, orphaned) = mpsc::channel();
        let input: Box<dyn Read + Send> = Box::new(Cursor::new(input));
        let pipe = ControlPipe::over(input, std::io::sink(), move || sender.send(()).unwrap());
        orphaned.recv_timeout(PATIENCE).expect("the end of the input is seen");
        assert!(pipe.stop_requested() && pipe.orphaned());
        for command in &expected {
            assert_eq!(pipe.next_within(PATIENCE).as_ref(), Some(command));
        }
        assert_eq!(pipe.next_within(Duration::ZERO), None);
        if expected.len() < lines { Verdict::Refused } else { Verdict::Accepted }
    });
}
