//! Answers requests to join: authenticates a host and leases places to it.

use std::time::Instant;

use dmprl_control::Greeting;
use dmprl_run::random_u64;

use super::{Gateway, GatewayEvent, HostChannel, RemoteWorker, RunFacts};
use crate::handshake::HostMessage;
use crate::host_messages::{HostAnswer, HostRequest, HostWelcome, Lease};
use crate::host_registry::Refusal;
use crate::keys::Key;
use crate::link::Request;
use crate::link_mode::Urgency;
use crate::link_receiver::LinkReceiver;
use crate::seal::{Opener, SealedSender};

/// Maximum length of a host's name in characters.
const NAME_MAX: usize = 64;

fn never(reason: String) -> Refusal {
    Refusal { reason, later: false }
}

impl Gateway {
    pub(super) fn answer(&mut self, request: &Request, now: Instant) -> anyhow::Result<()> {
        let message = request.bytes();
        let answer = self.respond(&message, now).unwrap_or_else(|refusal| {
            let Refusal { reason, later } = refusal;
            HostAnswer::Refused { reason, later }
        });
        let (bytes, session) = self.authenticator.answer(&message, &answer)?;
        if let HostAnswer::Welcome(welcome) = &answer {
            self.open_channel(welcome.channel, welcome.sealed.then_some(session))?;
        }
        request.answer(bytes)
    }

    /// Answers a message of the handshake. A host that has not proven that it knows the token gets
    /// only the challenge.
    fn respond(&mut self, bytes: &[u8], now: Instant) -> Result<HostAnswer, Refusal> {
        let message = self.parse(bytes)?;
        let Some(join) = &message.join else {
            return Ok(HostAnswer::Challenge(self.authenticator.challenge().to_owned()));
        };
        let request = self.authenticator.verify(&message.nonce, join);
        let request = request.inspect_err(|refusal| {
            let reason = refusal.reason.clone();
            self.report_refusal(|| format!("rejected a host: {reason}"));
        })?;
        Ok(HostAnswer::Welcome(Box::new(self.admit(&request, now)?)))
    }

    fn admit(&mut self, request: &HostRequest, now: Instant) -> Result<HostWelcome, Refusal> {
        if request.name.chars().count() > NAME_MAX {
            return Err(never(format!("its name has more than {NAME_MAX} characters (--name)")));
        }
        if self.acknowledged.marks.is_empty() {
            let reason = "the learner has not reported its workers' progress yet".to_owned();
            return Err(Refusal { reason, later: true });
        }
        let channel = random_u64().map_err(|error| never(format!("{error:#}")))?;
        let known = self.registry.hosts().iter().find(|host| host.host == request.host);
        // `dmprl bridge` has joined already, and its relay joins again: that is no news to the
        // user.
        let was_present = request.lease.is_some() && known.is_some_and(|host| host.is_present);
        let lease = self.registry.admit(request, channel, &self.acknowledged.marks, now)?;
        let (hosts, before) = (self.registry.hosts(), self.channels.len());
        self.channels.retain(|channel, _| hosts.iter().any(|host| host.channel == *channel));
        if self.channels.len() < before {
            self.channels_changed = now;
        }
        self.add_workers(lease, request.workers);
        if !was_present {
            let again = if request.lease.is_some() { "is back" } else { "takes part" };
            let workers = request.workers;
            let counted = format!("{workers} worker{}", if workers == 1 { "" } else { "s" });
            let name = request.name.escape_debug();
            self.events.push(GatewayEvent::Notice(format!("host {name} {again}: {counted}")));
        }
        let RunFacts { run_id, config, spec, .. } = self.facts.clone();
        let sealed = request.sealed || !self.link.is_authenticated();
        Ok(HostWelcome { channel, gateway: self.id, sealed, lease, run_id, config, spec })
    }

    /// Parses a message of the handshake and checks its version.
    fn parse(&mut self, bytes: &[u8]) -> Result<HostMessage, Refusal> {
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
        serde_json::from_slice(bytes)
            .map_err(|error| never(format!("expected a request, got another: {error}")))
    }

    /// Reports a rejected request, less and less often: repeated requests must not fill the log.
    fn report_refusal(&mut self, notice: impl FnOnce() -> String) {
        self.refusals += 1;
        if self.refusals.is_power_of_two() {
            self.events.push(GatewayEvent::Notice(notice()));
        }
    }

    /// Opens the channel of a host that has joined.
    fn open_channel(&mut self, channel: u64, session: Option<Key>) -> anyhow::Result<()> {
        let name = format!("dmprl/{}/hearings/{channel:016x}", self.facts.run_id);
        let acks = self.link.sender(name, Urgency::First)?;
        let key = session.as_ref();
        let opened = HostChannel {
            segments: Opener::new(key, "segments"),
            status: Opener::new(key, "status"),
            acks: SealedSender::new(acks, key, "acks"),
            policies: None,
            session,
        };
        self.channels.insert(channel, opened);
        Ok(())
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
