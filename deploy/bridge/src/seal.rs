//! Keyed hashes on all messages of a host that has joined, unless the link is authenticated itself:
//! a `tls/` link with the certificates that are derived from the run's token.
//!
//! A sealed message is the message, its number and a keyed hash over both (BLAKE3, truncated to
//! 128 bits). Each kind of message has its own key, so that no message can be taken for one of
//! another host, kind or session. Numbers increase, so that none is taken twice; lost messages
//! leave gaps.

use blake3::Hasher;
use subtle::ConstantTimeEq;

use crate::keys::Key;
use crate::link::{MessageReceiver, MessageSender};

const NUMBER_BYTES: usize = 8;
const TAG_BYTES: usize = 16;
/// Bytes that sealing adds to a message.
pub const SEAL_BYTES: usize = NUMBER_BYTES + TAG_BYTES;

/// Seals messages of one kind.
#[derive(Debug)]
pub struct Sealer {
    keyed: Option<Hasher>,
    number: u64,
}

/// Verifies messages of one kind.
#[derive(Debug)]
pub struct Opener {
    keyed: Option<Hasher>,
    /// Number of the last message, from 1.
    last: u64,
}

fn keyed(session: Option<&Key>, kind: &str) -> Option<Hasher> {
    session.map(|session| Hasher::new_keyed(session.derive(&[b"kind", kind.as_bytes()]).bytes()))
}

fn tag(keyed: &Hasher, signed: &[u8]) -> [u8; TAG_BYTES] {
    let mut tag = [0; TAG_BYTES];
    keyed.clone().update(signed).finalize_xof().fill(&mut tag);
    tag
}

impl Sealer {
    /// Creates the sealer of a kind of message in a session; without a key it changes nothing.
    #[must_use]
    pub fn new(session: Option<&Key>, kind: &str) -> Self {
        Self { keyed: keyed(session, kind), number: 0 }
    }

    /// Appends number and keyed hash to a message.
    #[must_use]
    pub fn seal(&mut self, mut message: Vec<u8>) -> Vec<u8> {
        let Some(keyed) = &self.keyed else { return message };
        self.number += 1;
        message.extend_from_slice(&self.number.to_le_bytes());
        let tag = tag(keyed, &message);
        message.extend_from_slice(&tag);
        message
    }
}

impl Opener {
    /// Creates the opener of a kind of message in a session; without a key it accepts all.
    #[must_use]
    pub fn new(session: Option<&Key>, kind: &str) -> Self {
        Self { keyed: keyed(session, kind), last: 0 }
    }

    /// Returns the message; `None` if it was forged, changed or repeated.
    pub fn open<'a>(&mut self, sealed: &'a [u8]) -> Option<&'a [u8]> {
        let Some(keyed) = &self.keyed else { return Some(sealed) };
        let (signed, claimed) = sealed.split_last_chunk::<TAG_BYTES>()?;
        let (message, number) = signed.split_last_chunk::<NUMBER_BYTES>()?;
        let number = u64::from_le_bytes(*number);
        let is_genuine = bool::from(tag(keyed, signed).ct_eq(claimed));
        if !is_genuine || number <= self.last {
            return None;
        }
        self.last = number;
        Some(message)
    }
}

/// Sends sealed messages under one name.
#[derive(Debug)]
pub struct SealedSender {
    sender: MessageSender,
    sealer: Sealer,
}

impl SealedSender {
    /// Creates the sender of a kind of message in a session.
    #[must_use]
    pub fn new(sender: MessageSender, session: Option<&Key>, kind: &str) -> Self {
        Self { sender, sealer: Sealer::new(session, kind) }
    }

    /// Seals and sends a message; blocks on a full link.
    ///
    /// # Errors
    /// The session is closed.
    pub fn send(&mut self, message: Vec<u8>) -> anyhow::Result<()> {
        self.sender.send(self.sealer.seal(message))
    }
}

/// Receives sealed messages under one name.
#[derive(Debug)]
pub struct SealedReceiver {
    receiver: MessageReceiver,
    opener: Opener,
}

impl SealedReceiver {
    /// Creates the receiver of a kind of message in a session.
    #[must_use]
    pub fn new(receiver: MessageReceiver, session: Option<&Key>, kind: &str) -> Self {
        Self { receiver, opener: Opener::new(session, kind) }
    }

    /// Reads the next message, without waiting. `read` gets `None` for a forged, changed or
    /// repeated one. Returns `None` if there is no message.
    ///
    /// # Errors
    /// The session is closed.
    pub fn next<T>(&mut self, read: impl FnOnce(Option<&[u8]>) -> T) -> anyhow::Result<Option<T>> {
        let Some(message) = self.receiver.next()? else { return Ok(None) };
        Ok(Some(read(self.opener.open(&message.bytes()))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn session(token: &str) -> Key {
        Key::from_token(token, "session")
    }

    fn sealer(key: &Key, kind: &str) -> Sealer {
        Sealer::new(Some(key), kind)
    }

    fn opener(key: &Key, kind: &str) -> Opener {
        Opener::new(Some(key), kind)
    }

    #[test]
    fn sealed_messages_are_opened_once_and_in_order() {
        let key = session("one");
        let (mut sealer, mut opener) = (sealer(&key, "acks"), opener(&key, "acks"));
        let [first, second, third] =
            [&b"first"[..], b"", b"third"].map(|it| sealer.seal(it.into()));
        assert_eq!(first.len(), 5 + SEAL_BYTES);
        assert_eq!(opener.open(&first), Some(&b"first"[..]));
        assert_eq!(opener.open(&first), None, "a replay");
        assert_eq!(opener.open(&third), Some(&b"third"[..]), "the second one was lost");
        assert_eq!(opener.open(&second), None, "and is too late");
    }

    #[test]
    fn messages_of_an_authenticated_link_stay_as_they_are() {
        let sealed = Sealer::new(None, "acks").seal(b"a message".to_vec());
        assert_eq!(sealed, b"a message");
        assert_eq!(Opener::new(None, "acks").open(&sealed), Some(&sealed[..]));
    }

    #[test]
    fn changed_message_or_one_of_another_kind_or_session_is_rejected() {
        let key = session("one");
        let sealed = sealer(&key, "acks").seal(b"a message".to_vec());
        for at in 0..sealed.len() {
            let mut changed = sealed.clone();
            changed[at] ^= 1;
            assert_eq!(opener(&key, "acks").open(&changed), None, "byte {at}");
            assert_eq!(opener(&key, "acks").open(&sealed[..at]), None, "cut at {at}");
        }
        assert_eq!(opener(&key, "policies").open(&sealed), None);
        assert_eq!(opener(&session("other"), "acks").open(&sealed), None);
        assert!(opener(&key, "acks").open(&sealed).is_some());
    }
}
