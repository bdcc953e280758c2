//! Events of a run. The supervisor passes them to an observer, which displays or writes them.

use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;
use std::time::Duration;

use dmprl_control::{EvaluationRow, Progress};
use dmprl_run::format::{grouped, plus_minus, shown};

use super::logs::log_tail;
use super::process::Process;
use super::restart_policy::Death;

/// Receives the events of a run in order, on the supervisor's thread: a slow observer delays it.
pub trait RunObserver {
    /// Handles an event.
    fn on_event(&mut self, event: RunEvent);

    /// Whether the observer shows the processes. Their states are computed only if it does.
    fn shows_processes(&self) -> bool {
        false
    }
}

/// An event of a run. Its `Display` is a message for the user, empty if there is none.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEvent {
    /// The session begins.
    Started {
        /// Task, algorithm, seed and workers in one line.
        title: String,
        /// Run directory.
        run: PathBuf,
        /// Endpoint of the learner, if it is on another host.
        learner: Option<String>,
        /// Evaluations of earlier sessions, oldest first.
        evaluations: Vec<EvaluationRow>,
    },
    /// A process was started.
    ChildStarted {
        /// Its name.
        process: Process,
        /// Number of the start in this session, from 0.
        start: u32,
    },
    /// A worker that a user started has joined the run.
    Joined {
        /// Its name.
        process: Process,
        /// Number of attached workers, this one included.
        workers: usize,
    },
    /// A worker that had joined has ended.
    Left {
        /// Its name.
        process: Process,
        /// Why, unless it left by itself.
        death: Option<Death>,
        /// Whether it announced that it leaves.
        announced: bool,
        /// Number of attached workers that remain.
        workers: usize,
    },
    /// The first environment step has reached the learner.
    FirstStep {
        /// Time since the start of the session, or since the death of the previous learner.
        after: Duration,
        /// Whether the learner replaced a dead one.
        is_successor: bool,
    },
    /// The learner has reported its progress.
    Progress {
        /// The report.
        progress: Progress,
        /// States of all processes, if the observer shows them.
        processes: Vec<ProcessLine>,
    },
    /// States of all processes, between two reports of progress.
    Processes(Vec<ProcessLine>),
    /// The learner has returned to a checkpoint.
    Rewound {
        /// Evaluations up to this checkpoint, oldest first.
        evaluations: Vec<EvaluationRow>,
    },
    /// An evaluation is complete.
    Evaluated {
        /// Its row in `evaluations.jsonl`.
        row: EvaluationRow,
        /// Whether it is the best of the run so far.
        is_best: bool,
    },
    /// A requested evaluation will have no row.
    NotEvaluated {
        /// Version of the policy.
        policy_version: u64,
        /// Reason.
        reason: NotEvaluated,
    },
    /// The learner has written a checkpoint.
    Checkpoint {
        /// Its directory below `checkpoints/`.
        name: String,
        /// Environment steps in it.
        env_steps: u64,
    },
    /// Environments have failed. Shown whenever their number has doubled.
    EnvFailure {
        /// The process with the environments.
        process: Process,
        /// Failures in this session.
        count: u64,
        /// Message of the last failure.
        last: String,
        /// Log with all of them; `None` if the process has its own terminal.
        log: Option<PathBuf>,
    },
    /// A process has died.
    ChildDied {
        /// Its name.
        process: Process,
        /// Kind and cause of the death.
        death: Death,
        /// Its log.
        log: PathBuf,
        /// Consequence.
        next: AfterDeath,
    },
    /// The run ends before its last step.
    Draining {
        /// Reason.
        reason: String,
    },
    /// The user has interrupted the run.
    Interrupted {
        /// What happens before it ends.
        before_the_end: &'static str,
    },
    /// Processes that did not stop were killed.
    Killed {
        /// Their names.
        processes: Vec<Process>,
        /// Reason.
        reason: &'static str,
    },
    /// A warning for the user.
    Warning {
        /// The process that caused it.
        process: Option<Process>,
        /// Text of the warning.
        message: String,
    },
    /// All processes have ended.
    Ended,
}

/// Reason why a requested evaluation has no row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NotEvaluated {
    /// Its episodes failed.
    Failed {
        /// The error.
        reason: String,
        /// Log of the evaluator.
        log: PathBuf,
    },
    /// Too many requests were waiting.
    TooFarBehind {
        /// Environment steps of the policy.
        env_steps: u64,
    },
    /// The learner died. Its successor requests the evaluations after its checkpoint again.
    LearnerDied,
    /// The run stops.
    Stopping,
}

/// Consequence of the death of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AfterDeath {
    /// It is restarted.
    Restart {
        /// Number of the restart since the restart budget was last reset.
        restart: u32,
        /// Maximum of this number.
        restarts_max: u32,
        /// Time until the restart.
        back_off: Duration,
    },
    /// A worker is given up.
    WorkerGivenUp {
        /// Number of its restarts.
        restarts: u32,
        /// Workers that remain.
        left: usize,
        /// Configured workers and workers that have joined.
        of: usize,
    },
    /// The gateway is given up, and with it the workers of other hosts.
    GatewayGivenUp {
        /// Number of its restarts.
        restarts: u32,
    },
}

/// A process of the run, as seen by the supervisor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessLine {
    /// Name, such as `learner` or `actor-0`.
    pub name: String,
    /// Short description of its activity.
    pub state: String,
    /// Number of restarts.
    pub restarts: u32,
}

/// Formats a number of workers.
pub(super) fn counted(workers: usize) -> String {
    format!("{workers} worker{}", if workers == 1 { "" } else { "s" })
}

impl Display for RunEvent {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Started { title, run, learner: None, .. } => {
                write!(out, "training {title} in {}", shown(run))
            }
            Self::Started { title, run, learner: Some(endpoint), .. } => {
                write!(out, "{title} for the learner at {endpoint}, in {}", shown(run))
            }
            Self::Joined { process, workers } => {
                write!(out, "{process} has joined: {}", counted(*workers))
            }
            Self::Left { process, death, announced, workers } => {
                let how = match death {
                    Some(death) => death.to_string(),
                    None if *announced => "left the run".to_owned(),
                    None => "died (see its terminal)".to_owned(),
                };
                write!(out, "joined worker {process} {how}: {}", counted(*workers))
            }
            Self::FirstStep { after, is_successor } => {
                let seconds = after.as_secs_f64();
                match is_successor {
                    true => write!(
                        out,
                        "the learner is back: first segment {seconds:.1} s after its death"
                    ),
                    false => write!(out, "first environment step after {seconds:.1} s"),
                }
            }
            Self::Evaluated { row, is_best } => {
                let (steps, figure) = (grouped(row.env_steps), plus_minus(&row.returns));
                write!(out, "evaluation at {steps} steps: return {figure}")?;
                if let Some(rate) = row.success_rate {
                    write!(out, ", success {:.0} %", rate * 100.0)?;
                }
                out.write_str(if *is_best { "  (best)" } else { "" })
            }
            Self::NotEvaluated { policy_version, reason } => reason.write(*policy_version, out),
            Self::Checkpoint { name, env_steps } => {
                write!(out, "checkpoint {name} at {} steps", grouped(*env_steps))
            }
            Self::EnvFailure { process, count, last, log } => {
                let count = grouped(*count);
                write!(out, "{process}: environment failure {count}: {last}; ")?;
                out.write_str("its segment is discarded; ")?;
                match log {
                    Some(log) => write!(out, "log: {}", shown(log)),
                    None => out.write_str("see its terminal"),
                }
            }
            Self::ChildDied { process, death, log, next } => {
                write!(out, "{process} {death}")?;
                next.write(log, out)
            }
            Self::Draining { reason } => write!(out, "{reason}: finishing the run"),
            Self::Interrupted { before_the_end } => {
                write!(out, "interrupted: {before_the_end} (interrupt again to stop at once)")
            }
            Self::Killed { processes, reason } => {
                let names: Vec<_> = processes.iter().map(ToString::to_string).collect();
                write!(out, "{reason}: killed {}", names.join(", "))
            }
            Self::Warning { message, .. } => out.write_str(message),
            Self::ChildStarted { .. }
            | Self::Progress { .. }
            | Self::Processes(_)
            | Self::Rewound { .. }
            | Self::Ended => Ok(()),
        }
    }
}

impl NotEvaluated {
    fn write(&self, policy_version: u64, out: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed { reason, log } => write!(
                out,
                "no evaluation of policy {policy_version}, the run continues: {reason}; log: {}",
                shown(log)
            ),
            Self::TooFarBehind { env_steps } => write!(
                out,
                "the evaluator is too far behind: skipping the evaluation at {} steps",
                grouped(*env_steps)
            ),
            Self::LearnerDied | Self::Stopping => Ok(()),
        }
    }
}

impl AfterDeath {
    fn write(&self, log: &std::path::Path, out: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Restart { restart, restarts_max, back_off } => write!(
                out,
                ": restart {restart} of {restarts_max} in {:.1} s; log: {}",
                back_off.as_secs_f64(),
                shown(log)
            ),
            Self::WorkerGivenUp { restarts, left, of } => write!(
                out,
                " again: giving up on it after {restarts} restarts, continuing with {left} of {of} \
                 workers{}",
                log_tail(log)
            ),
            Self::GatewayGivenUp { restarts } => write!(
                out,
                ": giving up on it after {restarts} restarts; the run continues without other \
                 hosts{}",
                log_tail(log)
            ),
        }
    }
}
