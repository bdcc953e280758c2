//! One host's part in a run whose learner is on another: its workers and their relay.

use std::path::PathBuf;

use anyhow::Context;
use dmprl_shared::config::ExperimentConfig;

use super::{
    Ending, Launcher, SupervisorPlan, TimeLimits, Upstream, domain, interrupts, supervise, title,
};
use crate::failure::Outcome;
use crate::run_directory::{RunDirectory, RunLock};
use crate::terminal::{Display, ProgressStyle, grouped, say, shown};

/// A host that takes part.
pub struct HostPlan {
    /// The program that plays the roles: this one.
    pub program: PathBuf,
    /// This host's directory of the run.
    pub run: RunDirectory,
    /// Held until the end, and by every child.
    pub lock: RunLock,
    /// The run's configuration, as it is on this host.
    pub config: ExperimentConfig,
    /// The Python virtual environment.
    pub venv: PathBuf,
    /// The learner's host.
    pub upstream: Upstream,
    /// The session as which its workers' incarnations are counted.
    pub session: u32,
    /// Bar or lines.
    pub progress: ProgressStyle,
}

/// Steps environments for the run until it ends or the user stops it.
///
/// # Errors
/// Whatever kept the host from going on.
pub fn host(plan: HostPlan) -> anyhow::Result<Outcome> {
    let HostPlan { program, run, lock, config, venv, upstream, session, progress } = plan;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the supervisor's runtime")?;
    // Before the shared memory: a signal that still kills would leave it behind.
    let interrupts = runtime.block_on(async { interrupts() })?;
    let domain = domain::create(&domain::token(&run.manifest()?, std::process::id()))?;
    let mut display = Display::new(progress, config.run.steps).of_host();
    display.message(&format!(
        "{} for the learner at {}, in {}",
        title(&config),
        upstream.endpoint,
        shown(run.path())
    ));
    let launcher = Launcher {
        program,
        run: run.clone(),
        venv: Some(venv),
        domain: Some(domain.path().to_owned()),
        resume: false,
        init_from: None,
        learner_restarts: 0,
        sessions_before: session,
        journal: None,
        upstream: Some(upstream),
    };
    let limits = TimeLimits::default();
    let report = runtime.block_on(async {
        supervise(SupervisorPlan { launcher, config, limits, display, interrupts }).await
    });
    // In this order: no child, then nothing half-made, then no lock.
    drop(runtime);
    drop(domain);
    drop(lock);
    let segments = report.last.as_ref().map_or(0, |progress| progress.segments);
    let acknowledged = format!("{} segments acknowledged", grouped(segments));
    match report.ending {
        Ending::Failed(error) => Err(error),
        Ending::Interrupted => {
            say(&format!("left the run: {acknowledged}"));
            Ok(Outcome::Interrupted)
        }
        Ending::Completed => {
            say(&format!("the run has ended: {acknowledged}"));
            Ok(Outcome::Done)
        }
    }
}
