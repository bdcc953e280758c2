//! The messages between a host and the gateway that admitted it.

use crate::join::Admission;
use crate::link::{Link, MessageReceiver, Presence};
use crate::link_mode::Urgency;
use crate::seal::{SealedReceiver, SealedSender};

/// Senders and receivers of one admission.
pub(super) struct Channel {
    pub segments: SealedSender,
    pub status: SealedSender,
    pub acks: SealedReceiver,
    pub policies: SealedReceiver,
    /// Arrival and departure of gateways, and the id of the gateway that opened this channel.
    gateways: MessageReceiver,
    gateway: u64,
    _presence: Presence,
}

impl Channel {
    pub(super) fn open(link: &Link, admission: &Admission) -> anyhow::Result<Self> {
        let Admission { welcome, session } = admission;
        let session = session.as_ref();
        let name = |what: &str| format!("dmprl/{}/{what}/{:016x}", welcome.run_id, welcome.channel);
        let receiver = |what: &str, kind: &str| {
            Ok::<_, anyhow::Error>(SealedReceiver::new(link.receiver(&name(what))?, session, kind))
        };
        let sender = |kind: &str, urgency| {
            Ok::<_, anyhow::Error>(SealedSender::new(
                link.sender(name(kind), urgency)?,
                session,
                kind,
            ))
        };
        Ok(Self {
            gateways: link.presences(&format!("dmprl/{}/gateway/*", welcome.run_id))?,
            gateway: welcome.gateway,
            acks: receiver("hearings", "acks")?,
            policies: receiver("policies", "policies")?,
            segments: sender("segments", Urgency::Segments)?,
            status: sender("status", Urgency::First)?,
            _presence: link.announce(name("hosts"))?,
        })
    }

    /// Returns true if the gateway that opened the channel is gone, or another has appeared.
    pub(super) fn is_in_doubt(&self) -> anyhow::Result<bool> {
        let mut doubt = false;
        while let Some(message) = self.gateways.next()? {
            let ours = u64::from_str_radix(message.last_name(), 16) == Ok(self.gateway);
            doubt |= ours != message.is_arrival();
        }
        Ok(doubt)
    }
}
