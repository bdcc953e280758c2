//! Stage 2 of 8: the processes of a run, from the first start to the last exit.
//!
//! ```text
//!  train ─► session ─► supervisor ─┬─ actor × N      environment_ready … attach
//!             │                    ├─ learner        from the first environment_ready on
//!          domain, lock            └─ evaluator      from learner_ready on
//! ```
//! With `run.deterministic` there is one child, `learner --one-process`, which does everything.
//!
//! Who ends whom: a child ignores terminal signals and ends on `stop` or at the end of its
//! standard input, which the death of the supervisor brings about, whatever killed it. No
//! parent-death signal is used: it would kill the learner before its last checkpoint. The run's
//! lock is inherited, so a `resume` waits for such an orphan.
//!
//! Every wait has a limit in [`TimeLimits`]. The supervisor itself is one loop over events,
//! interrupts and the next deadline; it never waits anywhere else.

mod child;
mod children;
mod conversation;
mod domain;
mod evaluate;
mod evaluations;
mod film;
mod host;
mod hosts;
mod joining;
mod launcher;
mod limits;
mod logs;
mod machine;
pub(crate) mod members;
mod observe;
mod observer;
mod process;
mod reports;
mod restart_policy;
mod session;
mod shutdown;
mod signals;
#[cfg(test)]
mod simulation;
mod state;
mod step;
mod supervisor;
mod totals;
mod views;
mod whole_run;

pub(crate) use child::describe;
pub(crate) use domain::{Place, create as create_domain, token as domain_token};
pub use evaluate::{EvaluationPlan, evaluate};
pub use film::film;
pub use host::{HostPlan, host};
pub use launcher::{Launcher, Upstream};
pub use limits::TimeLimits;
pub(crate) use logs::last_lines;
pub use observe::{ObservationPlan, observe};
pub use observer::{AfterDeath, NotEvaluated, ProcessLine, RunEvent, RunObserver};
pub use process::Process;
pub use restart_policy::Death;
pub use session::{RESUME_WAIT, SessionPlan, Trial, session, title};
pub use signals::interrupts;
pub(crate) use signals::is_ignored;
pub use supervisor::{Ending, SessionReport, SupervisorPlan, supervise};
pub use totals::Totals;
pub(crate) use whole_run::WholeRun;
