//! Simulated children, whose actions are derived from a seed.

use std::collections::VecDeque;
use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use dmprl_control::{
    Activity, Command, EvaluationRequest, EvaluationRow, HostNow, Progress, Report,
};
use dmprl_run::ENV_HUNG_STATUS;
use dmprl_shared::seeds::Stream;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::Sent;
use rand::RngExt;

use crate::process::Process;

/// A simulated process.
pub struct Fake {
    pub process: Process,
    /// The process has joined, so it ends with [`Output::Gone`].
    pub joined: bool,
    behaviour: Behaviour,
    /// Commands not yet handled.
    commands: VecDeque<Command>,
    ready: bool,
    attached: bool,
    /// Number of progress reports until it finishes.
    work_left: u32,
    /// Time of its last output, which later outputs must follow.
    pub last_output: Instant,
}

/// Behaviour of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behaviour {
    Healthy,
    /// Dies or becomes silent at a random turn.
    Dying,
    /// Does nothing, but can be killed.
    Silent,
    /// Ignores commands to stop.
    IgnoresStop,
}

/// An output of a process.
#[derive(Debug, Clone)]
pub enum Output {
    Report(Report),
    Garbage,
    Exit(ExitStatus),
    Gone,
}

/// Settings that all children share.
#[derive(Debug, Clone, Copy)]
pub struct Mode {
    pub faults: bool,
    pub one_process: bool,
}

pub fn spec() -> EnvSpec {
    EnvSpec::new("Fake-v0", 2, &[(-1.0, 1.0)], 0.02, 50)
}

impl Fake {
    pub fn new(process: Process, mode: Mode, random: &mut Stream, now: Instant) -> Self {
        let behaviour = match random.random_range(0..20) {
            0..4 if mode.faults => Behaviour::Dying,
            4 if mode.faults => Behaviour::Silent,
            5 if mode.faults => Behaviour::IgnoresStop,
            _ => Behaviour::Healthy,
        };
        Self {
            process,
            joined: false,
            behaviour,
            commands: VecDeque::new(),
            ready: false,
            attached: false,
            work_left: random.random_range(1..40),
            last_output: now,
        }
    }

    pub fn command(&mut self, command: Command) {
        self.commands.push_back(command);
    }

    /// Makes a process healthy that would die at a random turn. A process that is silent or ignores
    /// commands stays so.
    pub fn heal(&mut self) {
        if self.behaviour == Behaviour::Dying {
            self.behaviour = Behaviour::Healthy;
        }
    }

    pub fn turn_after(&self, random: &mut Stream) -> Duration {
        Duration::from_millis(random.random_range(1..5_000))
    }

    /// Takes a turn and returns its outputs; the last one may be the exit.
    pub fn turn(&mut self, mode: Mode, random: &mut Stream, version: &mut u64) -> Vec<Output> {
        match self.behaviour {
            Behaviour::Silent => return Vec::new(),
            Behaviour::Dying => match random.random_range(0..12) {
                0 | 1 => return vec![self.death(random)],
                2 => {
                    self.behaviour = Behaviour::Silent;
                    return Vec::new();
                }
                _ => {}
            },
            Behaviour::Healthy | Behaviour::IgnoresStop => {}
        }
        let mut outputs = Vec::new();
        if !self.ready {
            self.ready = true;
            return self.readiness(mode);
        }
        while let Some(command) = self.commands.pop_front() {
            if self.obey(command, random, &mut outputs) {
                return outputs;
            }
        }
        match self.process {
            Process::Learner | Process::Relay => self.learn(mode, random, version, &mut outputs),
            Process::Actor(_) => self.step(random, &mut outputs),
            Process::Gateway => outputs.push(Output::Report(hosts(random))),
            Process::Evaluator => {}
        }
        outputs
    }

    fn readiness(&self, mode: Mode) -> Vec<Output> {
        let environment = Output::Report(Report::EnvironmentReady { spec: spec() });
        match self.process {
            Process::Learner if mode.one_process => {
                vec![environment, Output::Report(Report::LearnerReady)]
            }
            Process::Learner | Process::Relay => {
                vec![Output::Report(Report::LearnerReady), Output::Report(Report::FirstSegment)]
            }
            Process::Gateway => vec![Output::Report(Report::Hosts(Vec::new()))],
            Process::Actor(_) | Process::Evaluator => vec![environment],
        }
    }

    /// Handles a command; returns true if it ends the process.
    fn obey(&mut self, command: Command, random: &mut Stream, out: &mut Vec<Output>) -> bool {
        let ignores_stop = self.behaviour == Behaviour::IgnoresStop;
        match command {
            Command::Attach { .. } => self.attached = true,
            Command::Stop | Command::Finish if ignores_stop => {}
            Command::Finish if matches!(self.process, Process::Learner | Process::Relay) => {
                self.work_left = 0;
            }
            Command::Stop | Command::Finish => {
                out.extend(self.regular_end());
                return true;
            }
            Command::Evaluate(request) => out.push(Output::Report(answer(&request, random))),
            _ => {}
        }
        false
    }

    fn regular_end(&self) -> Vec<Output> {
        let exit = if self.joined { Output::Gone } else { Output::Exit(ExitStatus::default()) };
        match self.process {
            Process::Learner | Process::Relay => {
                vec![checkpoint(), Output::Report(Report::Finished), exit]
            }
            _ if self.joined => vec![Output::Report(Report::Left), exit],
            _ => vec![exit],
        }
    }

    fn learn(&mut self, mode: Mode, random: &mut Stream, version: &mut u64, out: &mut Vec<Output>) {
        if self.work_left == 0 {
            out.extend(self.regular_end());
            return;
        }
        self.work_left -= 1;
        let progress = Progress { env_steps: *version * 100 + 1, ..Progress::default() };
        out.push(Output::Report(Report::Progress(progress)));
        if self.process == Process::Relay {
            return;
        }
        *version += 1;
        match random.random_range(0..6) {
            0 => out.push(checkpoint()),
            1..4 if mode.one_process => out.push(Output::Report(Report::Evaluated(row(*version)))),
            1..4 => out.push(Output::Report(Report::Evaluate(request(*version)))),
            _ => {}
        }
    }

    fn step(&mut self, random: &mut Stream, out: &mut Vec<Output>) {
        let doing = if self.attached { Activity::Stepping } else { Activity::Attaching };
        let kept = random.random_range(0..5);
        out.push(Output::Report(Report::Alive { doing, kept }));
        if !self.attached {
            return;
        }
        let sent = random.random_range(0..4);
        let sent = Sent { produced: sent, sent, resent: 0, acked: sent / 2 };
        out.push(Output::Report(Report::Sent(sent)));
        if self.behaviour == Behaviour::Healthy {
            return;
        }
        match random.random_range(0..12) {
            0 => {
                let (count, last) = (random.random_range(1..4), "a broken arm".to_owned());
                out.push(Output::Report(Report::EnvFailures { count, last }));
            }
            1 => out.push(Output::Garbage),
            2 => {
                out.push(Output::Report(Report::EnvHung { message: "it hangs".to_owned() }));
                let status = ExitStatus::from_raw(ENV_HUNG_STATUS << 8);
                out.push(if self.joined { Output::Gone } else { Output::Exit(status) });
            }
            3 if self.joined => out.extend(self.regular_end()),
            _ => {}
        }
    }

    fn death(&self, random: &mut Stream) -> Output {
        // Killed, panicked, or exited with an error.
        let status = [9, 101 << 8, 9, 1 << 8][random.random_range(0..4)];
        if self.joined { Output::Gone } else { Output::Exit(ExitStatus::from_raw(status)) }
    }
}

fn checkpoint() -> Output {
    Output::Report(Report::Checkpoint { name: "000001".to_owned(), env_steps: 1 })
}

fn hosts(random: &mut Stream) -> Report {
    let host = HostNow {
        name: "far".to_owned(),
        here: random.random_range(0..2) == 0,
        workers: 2,
        kept: random.random_range(0..5),
        acked: 0,
        restarts: 0,
    };
    Report::Hosts(vec![host])
}

fn request(policy_version: u64) -> EvaluationRequest {
    EvaluationRequest { env_steps: 0, updates: 0, segments: 0, wall_s: 0.0, policy_version }
}

fn row(policy_version: u64) -> EvaluationRow {
    EvaluationRow {
        env_steps: 0,
        updates: 0,
        segments: 0,
        wall_s: 0.0,
        policy_version,
        returns: vec![0.0],
        return_mean: policy_version as f64,
        success_rate: None,
        smoothness: 0.0,
        at_bounds: None,
    }
}

fn answer(request: &EvaluationRequest, random: &mut Stream) -> Report {
    let policy_version = request.policy_version;
    match random.random_range(0..8) {
        0 => Report::NotEvaluated { policy_version, reason: "a broken arm".to_owned() },
        _ => Report::Evaluated(row(policy_version)),
    }
}
