//! Supervises a host without a learner: its workers and the relay to the learner's host.

use std::path::PathBuf;

use anyhow::Context;
use dmprl_run::title;
use dmprl_run::{LockWatch, RunDirectory};
use dmprl_shared::config::ExperimentConfig;

use super::domain;
use super::launcher::{Launcher, Upstream};
use super::limits::TimeLimits;
use super::observer::{RunEvent, RunObserver};
use super::signals::interrupts;
use super::supervisor::{SessionReport, SupervisorPlan, supervise};
use super::totals::Totals;

/// A host whose workers take part in the run of another host.
pub struct HostPlan {
    /// The program that plays the roles: this one.
    pub program: PathBuf,
    /// This host's directory of the run. The caller holds its lock until the session has ended, and
    /// children inherit it.
    pub run: RunDirectory,
    /// Tells whether the lock was lost.
    pub lock: LockWatch,
    /// The run's configuration, adapted to this host.
    pub config: ExperimentConfig,
    /// The Python virtual environment.
    pub venv: PathBuf,
    /// The learner's host.
    pub upstream: Upstream,
    /// Number of the session, from which its workers' incarnations are derived.
    pub session: u32,
}

/// Steps environments for the run until it ends or the user stops this host.
///
/// # Errors
/// The session could not start. Later failures are in the report.
pub fn host(plan: HostPlan, observer: &mut dyn RunObserver) -> anyhow::Result<SessionReport> {
    let HostPlan { program, run, lock, config, venv, upstream, session } = plan;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the supervisor's runtime")?;
    // Catch signals before creating shared memory: a fatal signal would leave it behind.
    let interrupts = runtime.block_on(async { interrupts() })?;
    let domain = domain::create(&domain::token(&run.manifest()?, std::process::id()))?;
    observer.on_event(RunEvent::Started {
        title: title(&config),
        run: run.path().to_owned(),
        learner: Some(upstream.endpoint.clone()),
        evaluations: Vec::new(),
    });
    let launcher = Launcher {
        program,
        run,
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
    let earlier = Totals::default();
    let plan = SupervisorPlan { launcher, lock, config, limits, earlier, interrupts };
    let report = runtime.block_on(supervise(plan, observer));
    // The runtime kills remaining children, which must not outlive their shared memory.
    drop(runtime);
    drop(domain);
    Ok(report)
}
