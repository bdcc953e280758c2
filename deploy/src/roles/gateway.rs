//! The gateway process: the workers of all other hosts, to the learner.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_shared::policy::Policy;
use dmprl_shared::transport::shared_memory::Plan;

use super::setup::Setup;
use super::{ControlPipe, GatewayArgs};
use crate::bridge::gateway::{Gateway, GatewayEvent, GatewaySettings, RunFacts};
use crate::bridge::token;
use crate::bridge::wire::RunState;
use crate::control::Report;
use crate::run_directory::{RunDirectory, TOKEN_FILE, replace_file};

/// In a run's directory: the first session that no host was given yet.
const SESSIONS_FILE: &str = "bridge.session";
/// Sleep of a turn that found nothing to do.
const IDLE: Duration = Duration::from_micros(300);
/// Between two reports of the hosts.
const REPORT_INTERVAL: Duration = Duration::from_millis(500);
/// A learner that is being replaced can be joined again after as long as a checkpoint takes.
const JOIN_LIMIT: Duration = Duration::from_secs(60);
const JOIN_PAUSE: Duration = Duration::from_millis(20);
/// Hosts are told so long how the run has ended, less than their supervisor waits for this process;
/// those that hear it leave.
const GOODBYE: Duration = Duration::from_secs(8);
/// One that was not heard from for so long is not waited for.
const GONE: Duration = Duration::from_secs(60);
const GOODBYE_INTERVAL: Duration = Duration::from_millis(100);
/// The first refusals of what nobody should have sent are told, then each doubling.
const REFUSED_FIRST: u64 = 1;

/// Where a run's secret is.
pub(crate) fn token_path(run: &RunDirectory, token_file: &str) -> PathBuf {
    match token_file {
        "" => run.path().join(TOKEN_FILE),
        file => PathBuf::from(file),
    }
}

/// Passes on what other hosts send until a stop is asked for.
pub fn run(args: &GatewayArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let Some(mut gateway) = open(args, control)? else { return Ok(()) };
    let mut reported: Option<Instant> = None;
    let mut refused_told = REFUSED_FIRST;
    let sessions = args.run.join(SESSIONS_FILE);
    let mut given = gateway.session();
    while !control.stop_requested() && !control.finish_requested() {
        let worked = gateway.turn()?;
        if given != gateway.session() {
            given = gateway.session();
            replace_file(&sessions, given.to_string().as_bytes())?;
        }
        for event in gateway.take_events() {
            // A supervisor that is gone is noticed as a stop.
            let _ = control.send(&match event {
                GatewayEvent::Notice(message) => {
                    eprintln!("{message}");
                    Report::Warning { message }
                }
                GatewayEvent::Sent(sent) => Report::Sent(sent),
                GatewayEvent::EnvFailures { count, host } => {
                    Report::EnvFailures { count, last: format!("on host {host}") }
                }
            });
        }
        if gateway.rejected() >= refused_told {
            let message = format!("{} messages of nobody, or damaged, refused", gateway.rejected());
            eprintln!("{message}");
            let _ = control.send(&Report::Warning { message });
            refused_told = gateway.rejected().saturating_mul(2);
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
    let policy = Policy::new(&setup.config, &spec)?;
    let (config, bridge) = (&setup.config, &setup.config.bridge);
    let facts = RunFacts {
        run_id: setup.run.manifest()?.run_id,
        config: toml::to_string(config).context("cannot write the configuration")?,
        spec,
        token: token::ensure(&token_path(&setup.run, &bridge.token_file))?,
    };
    let zenoh_file =
        Some(Path::new(&bridge.zenoh_file)).filter(|path| !path.as_os_str().is_empty());
    let session = args.session.max(sessions_given(&args.run.join(SESSIONS_FILE))?);
    let deadline = Instant::now() + JOIN_LIMIT;
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
            // Only the learner comes back by itself.
            Err(error) if !is_transport(&error) || Instant::now() >= deadline => return Err(error),
            Err(_) if control.stop_requested() => return Ok(None),
            Err(_) => std::thread::sleep(JOIN_PAUSE),
        }
    }
}

/// How many sessions the gateways before this one have given to hosts; a worker's start has the
/// number of none of them again.
fn sessions_given(path: &Path) -> anyhow::Result<u32> {
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

/// Tells the hosts whether the run is complete or only stops.
fn say_goodbye(gateway: &mut Gateway, control: &ControlPipe) -> anyhow::Result<()> {
    let state = if control.finish_requested() { RunState::Complete } else { RunState::Stopped };
    let began = Instant::now();
    loop {
        gateway.send_acks(state)?;
        gateway.read_statuses(Instant::now())?;
        // A run that was stopped has hosts that wait for it.
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
