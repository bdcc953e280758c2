//! The relay's process: runs the bridge's relay and reports to the host's supervisor.

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_bridge::host_messages::Lease;
use dmprl_bridge::join::JoinSettings;
use dmprl_bridge::relay::{HostCounts, Relay, RelaySettings, Turn};
use dmprl_bridge::token;
use dmprl_control::{Progress, Report};
use dmprl_run::Setup;
use dmprl_shared::policy::Policy;
use dmprl_shared::transport::shared_memory::Plan;

use super::{ControlPipe, RelayArgs};

/// Sleep after a turn without work.
const IDLE: Duration = Duration::from_micros(300);
const REPORT_INTERVAL: Duration = Duration::from_millis(500);
/// Silence of the learner's host after which it is reported.
const AWAY_REPORTED: Duration = Duration::from_secs(2);
/// Maximum wait of a leaving host for the acknowledgement of its segments.
const HAND_OVER: Duration = Duration::from_secs(5);

/// Runs the relay until the run is complete or a stop is requested.
pub fn run(args: &RelayArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let mut relay = start(args)?;
    let mut reporter = RelayReporter::new(args);
    loop {
        let turn = relay.turn(&counts(control))?;
        reporter.report(&relay, control)?;
        if turn == Turn::Complete {
            reporter.report_ready(&relay, control);
            // The gateway waits until all hosts have left.
            relay.leave(&counts(control))?;
            return control.send(&Report::Finished);
        }
        if control.stop_requested() {
            return leave(&mut relay, control);
        }
        if turn == Turn::Idle {
            std::thread::sleep(IDLE);
        }
    }
}

fn start(args: &RelayArgs) -> anyhow::Result<Relay> {
    let setup = Setup::read(&args.run)?;
    let spec = setup.run.spec()?.context("the run has no spec.json: start the bridge again")?;
    let policy = Policy::new(setup.config.policy_description(&spec))?;
    let plan = Plan::new(&setup.config, setup.run_id, &policy);
    let join = JoinSettings {
        endpoint: args.connect.clone(),
        token: token::read(&args.token_file)?,
        host: args.host,
        name: args.name.clone(),
        workers: u32::try_from(setup.config.actors.workers).context("too many workers")?,
    };
    Relay::start(RelaySettings {
        join,
        lease: Lease { first: args.first, session: args.session },
        zenoh_file: args.zenoh_config.as_deref(),
        domain: &args.domain,
        plan: &plan,
        segments_max: setup.config.delivery.unacknowledged_segments,
        in_flight_bytes_max: setup.config.bridge.under_way_bytes_max,
    })
}

fn counts(control: &ControlPipe) -> HostCounts {
    let (sent, env_failures) = (control.sent(), control.env_failures());
    HostCounts { sent, env_failures, workers: control.workers() }
}

/// Delivers the segments of the workers, including those that they are still finishing, and leaves
/// the run. Gives up after `HAND_OVER`, or if the learner's host is unreachable.
fn leave(relay: &mut Relay, control: &ControlPipe) -> anyhow::Result<()> {
    let deadline = Instant::now() + HAND_OVER;
    while relay.away().is_none() && !control.orphaned() && Instant::now() < deadline {
        // Before the turn: workers that are gone have sent all their segments.
        let gone = control.workers().count == 0;
        let turn = relay.turn(&counts(control))?;
        if turn == Turn::Complete || turn == Turn::Idle && gone && relay.in_flight() == 0 {
            break;
        }
        if turn == Turn::Idle {
            std::thread::sleep(IDLE);
        }
    }
    if relay.in_flight() > 0 {
        let message = format!(
            "{} segments are not acknowledged: those that reached the learner's host are used, the \
             others are lost",
            relay.in_flight()
        );
        warn(control, message);
    }
    relay.leave(&counts(control))
}

/// Reports the relay's state to the host's supervisor.
struct RelayReporter {
    patience: Duration,
    endpoint: String,
    ready: bool,
    first: bool,
    away: Option<(Instant, String)>,
    damaged: u64,
    reported: Instant,
    acked: u64,
}

impl RelayReporter {
    fn new(args: &RelayArgs) -> Self {
        Self {
            patience: Duration::from_secs(args.patience),
            endpoint: args.connect.clone(),
            ready: false,
            first: false,
            away: None,
            damaged: 0,
            reported: Instant::now(),
            acked: 0,
        }
    }

    fn report_ready(&mut self, relay: &Relay, control: &ControlPipe) {
        // Workers that attach wait for a policy only for a limited time.
        if !self.ready && relay.version() > 0 {
            self.ready = true;
            // If the supervisor is gone, the loop notices it as a stop.
            let _ = control.send(&Report::LearnerReady);
        }
    }

    fn report(&mut self, relay: &Relay, control: &ControlPipe) -> anyhow::Result<()> {
        self.report_ready(relay, control);
        if !self.first && relay.acked() > 0 {
            self.first = true;
            let _ = control.send(&Report::FirstSegment);
        }
        self.report_absence(relay, control)?;
        if relay.damaged() > self.damaged {
            self.damaged = relay.damaged();
            warn(control, format!("rejected {} damaged messages or segments", self.damaged));
        }
        let since = self.reported.elapsed();
        if since >= REPORT_INTERVAL {
            self.reported = Instant::now();
            let segments = relay.acked() - std::mem::replace(&mut self.acked, relay.acked());
            let _ = control.send(&Report::Progress(Progress {
                env_steps: relay.env_steps(),
                segments: relay.acked(),
                env_steps_per_s: segments as f64 * relay.segment_steps() as f64
                    / since.as_secs_f64(),
                queued_segments: control.workers().queued_segments,
                env_failures: control.env_failures(),
                restarts: control.workers().restarts,
                ..Progress::default()
            }));
        }
        Ok(())
    }

    /// Reports when and why the learner's host is unreachable, and when it is back. Fails after
    /// `patience`.
    fn report_absence(&mut self, relay: &Relay, control: &ControlPipe) -> anyhow::Result<()> {
        match (relay.away(), &self.away) {
            (Some((since, reason)), reported) => {
                let elapsed = since.elapsed();
                if elapsed >= self.patience {
                    bail!(
                        "waited {} s for the learner's host at {}: {reason}",
                        elapsed.as_secs(),
                        self.endpoint
                    );
                }
                let new = reported.as_ref().is_none_or(|(_, before)| before != reason);
                if new && elapsed >= AWAY_REPORTED {
                    let patience = self.patience.as_secs();
                    warn(control, format!("{reason}; workers wait for at most {patience} s"));
                    self.away = Some((*since, reason.clone()));
                }
            }
            (None, Some((since, _))) => {
                let seconds = since.elapsed().as_secs_f64();
                warn(control, format!("the learner's host is back after {seconds:.1} s"));
                self.away = None;
            }
            (None, None) => {}
        }
        Ok(())
    }
}

fn warn(control: &ControlPipe, message: String) {
    tracing::warn!("{message}");
    let _ = control.send(&Report::Warning { message });
}
