//! The gateway's process: runs the bridge's gateway and reports to the supervisor.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_bridge::gateway::{Gateway, GatewayEvent, GatewaySettings, RunFacts};
use dmprl_bridge::token;
use dmprl_bridge::wire::RunState;
use dmprl_control::Report;
use dmprl_run::Setup;
use dmprl_run::{RunDirectory, TOKEN_FILE, replace_file};
use dmprl_shared::policy::Policy;
use dmprl_shared::transport::shared_memory::Plan;
use tracing::warn;

use super::{ControlPipe, GatewayArgs};

/// File in the run directory with the first unused session number.
const SESSIONS_FILE: &str = "bridge.session";
/// Sleep after a turn without work.
const IDLE: Duration = Duration::from_micros(300);
/// Interval between two reports of the hosts.
const REPORT_INTERVAL: Duration = Duration::from_millis(500);
/// Time limit to attach to the learner. A learner that is being replaced first loads a checkpoint.
const ATTACH_LIMIT: Duration = Duration::from_secs(60);
const ATTACH_PAUSE: Duration = Duration::from_millis(20);
/// Maximum time to announce the end of the run to the hosts, which then leave. Shorter than the
/// supervisor's time limit for the exit of this process.
const GOODBYE: Duration = Duration::from_secs(8);
/// Silence after which the gateway no longer waits for a host.
const GONE: Duration = Duration::from_secs(60);
const GOODBYE_INTERVAL: Duration = Duration::from_millis(100);
/// Number of rejected messages at the first warning; the next ones follow at each doubling.
const REJECTED_FIRST: u64 = 1;

/// Path of a run's token.
pub(crate) fn token_path(run: &RunDirectory, token_file: &str) -> PathBuf {
    match token_file {
        "" => run.path().join(TOKEN_FILE),
        file => PathBuf::from(file),
    }
}

/// Runs the gateway until a stop is requested.
pub fn run(args: &GatewayArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let Some(mut gateway) = open(args, control)? else { return Ok(()) };
    let mut reported: Option<Instant> = None;
    let mut rejected_next = REJECTED_FIRST;
    let sessions = args.run.join(SESSIONS_FILE);
    let mut session = gateway.session();
    while !control.stop_requested() && !control.finish_requested() {
        let worked = gateway.turn()?;
        if session != gateway.session() {
            session = gateway.session();
            replace_file(&sessions, session.to_string().as_bytes())?;
        }
        for event in gateway.take_events() {
            // If the supervisor is gone, the loop notices it as a stop.
            let _ = control.send(&match event {
                GatewayEvent::Notice(message) => {
                    warn!("{message}");
                    Report::Warning { message }
                }
                GatewayEvent::Sent(sent) => Report::Sent(sent),
                GatewayEvent::EnvFailures { count, host } => {
                    Report::EnvFailures { count, last: format!("on host {host}") }
                }
            });
        }
        if gateway.rejected() >= rejected_next {
            let message = format!("rejected {} damaged or unexpected messages", gateway.rejected());
            warn!("{message}");
            let _ = control.send(&Report::Warning { message });
            rejected_next = gateway.rejected().saturating_mul(2);
        }
        if reported.is_none_or(|at| at.elapsed() >= REPORT_INTERVAL) {
            reported = Some(Instant::now());
            let _ = control.send(&Report::Hosts(gateway.hosts()));
        }
        if !worked {
            std::thread::sleep(IDLE);
        }
    }
    say_goodbye(&mut gateway, control)
}

fn open(args: &GatewayArgs, control: &ControlPipe) -> anyhow::Result<Option<Gateway>> {
    let setup = Setup::read(&args.run)?;
    let spec = setup.run.spec()?.context("the run has no spec.json; a worker writes it first")?;
    let policy = Policy::new(setup.config.policy_description(&spec))?;
    let (config, bridge) = (&setup.config, &setup.config.bridge);
    let facts = RunFacts {
        run_id: setup.run.manifest()?.run_id,
        config: toml::to_string(config).context("cannot write the configuration")?,
        spec,
        token: token::ensure(&token_path(&setup.run, &bridge.token_file))?,
    };
    let zenoh_file =
        Some(Path::new(&bridge.zenoh_file)).filter(|path| !path.as_os_str().is_empty());
    let session = args.session.max(sessions_used(&args.run.join(SESSIONS_FILE))?);
    let deadline = Instant::now() + ATTACH_LIMIT;
    loop {
        let settings = GatewaySettings {
            endpoints: &bridge.listen,
            zenoh_file,
            domain: &args.domain,
            plan: Plan::new(config, setup.run_id, &policy),
            first_worker: config.actors.places(),
            session,
            segments_max: config.delivery.unacknowledged_segments,
        };
        match Gateway::open(settings, facts.clone()) {
            Ok(gateway) => return Ok(Some(gateway)),
            // Errors of the transport can be temporary: the learner may be restarting.
            Err(error) if !is_transport(&error) || Instant::now() >= deadline => return Err(error),
            Err(_) if control.stop_requested() => return Ok(None),
            Err(_) => std::thread::sleep(ATTACH_PAUSE),
        }
    }
}

/// Number of sessions that earlier gateways gave to hosts. New hosts get later ones, so that no
/// incarnation is used twice.
fn sessions_used(path: &Path) -> anyhow::Result<u32> {
    if !path.exists() {
        return Ok(0);
    }
    let read = || format!("cannot read {}", path.display());
    let text = std::fs::read_to_string(path).with_context(read)?;
    text.trim().parse().with_context(read)
}

fn is_transport(error: &anyhow::Error) -> bool {
    error.is::<dmprl_shared::transport::TransportError>()
}

/// Tells the hosts whether the run is complete or was stopped.
fn say_goodbye(gateway: &mut Gateway, control: &ControlPipe) -> anyhow::Result<()> {
    let state = if control.finish_requested() { RunState::Complete } else { RunState::Stopped };
    let began = Instant::now();
    loop {
        gateway.send_acks(state)?;
        gateway.read_statuses(Instant::now())?;
        // Hosts of a stopped run do not leave: they wait for it to resume.
        let heard = state == RunState::Stopped && began.elapsed() >= GOODBYE_INTERVAL * 2;
        if heard
            || gateway.all_silent_for(GONE, Instant::now())
            || began.elapsed() >= GOODBYE
            || control.orphaned()
        {
            return Ok(());
        }
        std::thread::sleep(GOODBYE_INTERVAL);
    }
}
