//! Answers requests to join: authenticates a host and leases places to it.

use std::time::Instant;

use anyhow::Context;
use dmprl_control::Greeting;
use dmprl_run::random_u64;

use super::{Gateway, GatewayEvent, HostSenders, RemoteWorker, RunFacts};
use crate::host_messages::{HostAnswer, HostRequest, HostWelcome, Lease};
use crate::host_registry::Refusal;
use crate::link::Request;
use crate::link_mode::Urgency;
use crate::link_receiver::LinkReceiver;
use crate::token;

/// Maximum length of a host's name in characters.
const NAME_MAX: usize = 64;

fn never(reason: String) -> Refusal {
    Refusal { reason, later: false }
}

impl Gateway {
    pub(super) fn answer(&mut self, request: &Request, now: Instant) -> anyhow::Result<()> {
        let answer = match self.admit(&request.bytes(), now) {
            Ok(welcome) => HostAnswer::Welcome(Box::new(welcome)),
            Err(Refusal { reason, later }) => HostAnswer::Refused { reason, later },
        };
        request.answer(serde_json::to_vec(&answer).context("cannot write an answer")?)
    }

    fn admit(&mut self, bytes: &[u8], now: Instant) -> Result<HostWelcome, Refusal> {
        let request = self.authenticate(bytes)?;
        if request.name.chars().count() > NAME_MAX {
            return Err(never(format!("its name has more than {NAME_MAX} characters (--name)")));
        }
        if self.acknowledged.marks.is_empty() {
            let reason = "the learner has not reported its workers' progress yet".to_owned();
            return Err(Refusal { reason, later: true });
        }
        let channel = random_u64().map_err(|error| never(format!("{error:#}")))?;
        let known = self.registry.hosts().iter().find(|host| host.host == request.host);
        let before = known.map(|host| host.channel);
        // `dmprl bridge` has joined already, and its relay joins again: that is no news to the
        // user.
        let was_present = request.lease.is_some() && known.is_some_and(|host| host.is_present);
        let lease = self.registry.admit(&request, channel, &self.acknowledged.marks, now)?;
        if let Some(before) = before {
            self.senders.remove(&before);
            self.channels_changed = now;
        }
        let senders = self.host_senders(channel).map_err(|error| never(format!("{error:#}")))?;
        self.senders.insert(channel, senders);
        self.add_workers(lease, request.workers);
        if !was_present {
            let again = if request.lease.is_some() { "is back" } else { "takes part" };
            let workers = request.workers;
            let counted = format!("{workers} worker{}", if workers == 1 { "" } else { "s" });
            let name = request.name.escape_debug();
            self.events.push(GatewayEvent::Notice(format!("host {name} {again}: {counted}")));
        }
        let RunFacts { run_id, config, spec, .. } = self.facts.clone();
        Ok(HostWelcome { channel, gateway: self.id, lease, run_id, config, spec })
    }

    /// Parses a request and checks its version and its token.
    fn authenticate(&mut self, bytes: &[u8]) -> Result<HostRequest, Refusal> {
        // Parse the greeting first: another version's remaining fields may not parse.
        #[derive(serde::Deserialize)]
        struct Speaks {
            speaks: Greeting,
        }
        let this = Greeting::this();
        let Speaks { speaks } = serde_json::from_slice(bytes)
            .map_err(|_| never(format!("expected a request of {this}, got something else")))?;
        if speaks != this {
            let reason = format!("expected {this}, got {speaks}: start both from the same build");
            self.report_refusal(|| format!("rejected a host with {speaks}"));
            return Err(never(reason));
        }
        let request: HostRequest = serde_json::from_slice(bytes)
            .map_err(|error| never(format!("expected a request, got another: {error}")))?;
        if !token::equal(&request.token, &self.facts.token) {
            self.report_refusal(|| {
                let name = request.name.escape_debug().take(NAME_MAX).collect::<String>();
                format!("rejected host {name}: its token is wrong")
            });
            let reason = "its token is not the run's: copy bridge.token of the run's directory";
            return Err(never(reason.to_owned()));
        }
        Ok(request)
    }

    /// Reports a rejected request, less and less often: repeated requests must not fill the log.
    fn report_refusal(&mut self, notice: impl FnOnce() -> String) {
        self.refusals += 1;
        if self.refusals.is_power_of_two() {
            self.events.push(GatewayEvent::Notice(notice()));
        }
    }

    fn host_senders(&self, channel: u64) -> anyhow::Result<HostSenders> {
        let name = format!("dmprl/{}/hearings/{channel:016x}", self.facts.run_id);
        let acks = self.link.sender(name, Urgency::First)?;
        Ok(HostSenders { acks, policies: None })
    }

    /// Adds the host's workers. Workers that are known keep their retained segments.
    fn add_workers(&mut self, lease: Lease, workers: u32) {
        for worker in lease.first..lease.first + workers {
            let (index, layout) = (worker as usize, self.plan.layout);
            let receiver = || LinkReceiver::new(worker, layout, self.segments_max);
            let new = || RemoteWorker { index, receiver: receiver(), queue: None };
            self.workers.entry(index).or_insert_with(new);
        }
    }
}
