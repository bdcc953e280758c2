//! Stage 2 of 8: supervises the processes of a run, from the first start to the last exit.
//!
//! ```text
//!  train ─► session ─► supervisor ─┬─ actor × N      environment_ready … attach
//!             │                    ├─ learner        from the first environment_ready on
//!          domain, lock            └─ evaluator      from learner_ready on
//! ```
//! With `run.deterministic` there is one child, `learner --one-process`, which does everything.
//!
//! A child ignores terminal signals. It exits on `stop` or at the end of its standard input, which
//! closes when the supervisor dies. There is no parent-death signal, as it would kill the learner
//! before its last checkpoint. Children inherit the run's lock, so `resume` waits for orphans.
//!
//! The supervisor is a state machine (`machine.rs`) and a loop around it (`supervisor.rs`), which
//! waits for events, interrupts and the next deadline. Nothing else blocks. Every wait has a limit
//! in [`TimeLimits`]. A [`RunObserver`] receives all events and displays them.

mod answer;
pub mod capacity;
mod child;
mod children;
mod conversation;
mod domain;
mod evaluate;
mod evaluations;
mod film;
mod gpus;
mod host;
mod hosts;
mod joining;
mod launcher;
mod limits;
mod logs;
mod machine;
pub mod members;
mod observe;
mod observer;
mod process;
#[cfg(feature = "python")]
pub mod python_setup;
mod reports;
mod restart_policy;
mod session;
mod shutdown;
mod signals;
mod silence;
#[cfg(test)]
mod simulation;
mod state;
mod step;
mod supervisor;
mod suspension;
mod totals;
mod views;
mod whole_run;

pub use answer::answer;
pub use domain::{Place, create as create_domain, token as domain_token};
pub use evaluate::{EvaluationPlan, evaluate};
pub use film::{FilmProgram, film};
pub use gpus::gpus;
pub use host::{HostPlan, host};
pub use launcher::{Launcher, Upstream};
pub use limits::TimeLimits;
pub use observe::{ObservationPlan, observe};
pub use observer::{AfterDeath, NotEvaluated, ProcessLine, RunEvent, RunObserver};
pub use process::Process;
pub use restart_policy::Death;
pub use session::{RESUME_WAIT, SessionPlan, Trial, session};
pub use signals::interrupts;
pub use supervisor::{Ending, SessionReport, SupervisorPlan, supervise};
pub use totals::Totals;
pub use whole_run::WholeRun;
