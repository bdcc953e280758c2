//! The handshake by which a host joins a run: each end proves that it knows the run's token.
//!
//! ```text
//! host ── nonce ──────────────────────────────► gateway
//! host ◄── challenge, proof over both ───────── gateway
//! host ── request, proof over the challenge ──► gateway
//! host ◄── answer, proof over both ──────────── gateway
//! ```
//! Neither end uses anything that the other has not proven, and the token is never sent. The
//! gateway stores nothing for a host before the host's proof: all hosts get the same challenge
//! until it has been answered 1,024 times.

use std::collections::BTreeSet;

use anyhow::Context;
use dmprl_control::Greeting;
use dmprl_run::secret_file;
use serde::{Deserialize, Serialize};

use crate::host_messages::{HostAnswer, HostRequest};
use crate::host_registry::Refusal;
use crate::keys::Key;

/// Proven requests per challenge. Their nonces are stored, so that none is accepted twice.
pub(crate) const ANSWERS_MAX: usize = 1_024;
/// Length of a nonce in characters: 256 bits in hexadecimal digits.
const NONCE_CHARACTERS: usize = 64;

/// Returns the key of the handshake.
#[must_use]
pub fn join_key(token: &str) -> Key {
    Key::from_token(token, "dmprl bridge 2: join")
}

/// A host's message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostMessage {
    /// Program and version of the host.
    pub speaks: Greeting,
    /// Random number, different in each message. The answer's proof covers the whole message.
    pub nonce: String,
    /// The request to join; without it the host asks for the challenge.
    pub join: Option<ProvenRequest>,
}

/// A request to join, with a proof over nonce, challenge and request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProvenRequest {
    /// The gateway's challenge.
    pub challenge: String,
    /// JSON of a [`HostRequest`].
    pub request: String,
    /// Proof by the host.
    pub proof: String,
}

/// The gateway's answer, with a proof over it and the host's message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ProvenAnswer {
    /// JSON of a [`HostAnswer`].
    answer: String,
    proof: String,
}

/// A proven answer to a host.
#[derive(Debug)]
pub struct Received {
    /// The answer.
    pub answer: HostAnswer,
    /// Key of this message and its answer, from which those of later messages are derived.
    pub session: Key,
}

impl HostMessage {
    /// Creates a request for the challenge.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn hello() -> anyhow::Result<Self> {
        Ok(Self { speaks: Greeting::this(), nonce: secret_file::random()?, join: None })
    }

    /// Creates a request to join.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn join(key: &Key, challenge: String, request: &HostRequest) -> anyhow::Result<Self> {
        let request = serde_json::to_string(request).context("cannot write a request")?;
        let hello = Self::hello()?;
        let proof = key.prove(&request_parts(&hello.nonce, &challenge, &request));
        Ok(Self { join: Some(ProvenRequest { challenge, request, proof }), ..hello })
    }
}

fn request_parts<'a>(nonce: &'a str, challenge: &'a str, request: &'a str) -> [&'a [u8]; 4] {
    [b"request", nonce.as_bytes(), challenge.as_bytes(), request.as_bytes()]
}

/// Reads the answer to a host's message; `None` if it is not proven.
#[must_use]
pub fn read_answer(key: &Key, message: &[u8], bytes: &[u8]) -> Option<Received> {
    let ProvenAnswer { answer, proof } = serde_json::from_slice(bytes).ok()?;
    if !key.is_proof(&[b"answer", message, answer.as_bytes()], &proof) {
        return None;
    }
    let session = key.derive(&[b"session", message, answer.as_bytes()]);
    Some(Received { answer: serde_json::from_str(&answer).ok()?, session })
}

/// The gateway's end of the handshake.
#[derive(Debug)]
pub struct Authenticator {
    key: Key,
    challenge: String,
    /// Nonces of proven answers to the challenge.
    answered: BTreeSet<String>,
}

impl Authenticator {
    /// Creates the end that knows this token.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn new(token: &str) -> anyhow::Result<Self> {
        let challenge = secret_file::random()?;
        Ok(Self { key: join_key(token), challenge, answered: BTreeSet::new() })
    }

    /// The current challenge.
    #[must_use]
    pub fn challenge(&self) -> &str {
        &self.challenge
    }

    /// Returns the request of a host that has proven that it knows the token.
    ///
    /// # Errors
    /// The proof is wrong, repeated, or of an earlier challenge.
    pub fn verify(&mut self, nonce: &str, join: &ProvenRequest) -> Result<HostRequest, Refusal> {
        let never = |reason: String| Refusal { reason, later: false };
        let parts = request_parts(nonce, &join.challenge, &join.request);
        if nonce.len() != NONCE_CHARACTERS || !self.key.is_proof(&parts, &join.proof) {
            return Err(never("it does not know the run's token".to_owned()));
        }
        if join.challenge != self.challenge {
            let reason = "its challenge has expired; the host asks for the next one".to_owned();
            return Err(Refusal { reason, later: true });
        }
        if !self.answered.insert(nonce.to_owned()) {
            return Err(never("its request was sent before".to_owned()));
        }
        if self.answered.len() >= ANSWERS_MAX {
            self.challenge = secret_file::random().map_err(|error| never(format!("{error:#}")))?;
            self.answered.clear();
        }
        serde_json::from_str(&join.request)
            .map_err(|error| never(format!("expected a request, got another: {error}")))
    }

    /// Writes the answer to a host's message, with its proof. Returns also the session's key.
    ///
    /// # Errors
    /// Never for an answer that can be written as JSON.
    pub fn answer(&self, message: &[u8], answer: &HostAnswer) -> anyhow::Result<(Vec<u8>, Key)> {
        let answer = serde_json::to_string(answer).context("cannot write an answer")?;
        let proof = self.key.prove(&[b"answer", message, answer.as_bytes()]);
        let session = self.key.derive(&[b"session", message, answer.as_bytes()]);
        let bytes = serde_json::to_vec(&ProvenAnswer { answer, proof });
        Ok((bytes.context("cannot write an answer")?, session))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "a secret of some length";

    fn request() -> HostRequest {
        HostRequest { host: 1, name: "a".into(), workers: 2, sealed: true, lease: None }
    }

    /// A host's proven request to this gateway.
    fn joining(gateway: &Authenticator, token: &str) -> HostMessage {
        let challenge = gateway.challenge().to_owned();
        HostMessage::join(&join_key(token), challenge, &request()).unwrap()
    }

    fn verify(gateway: &mut Authenticator, message: &HostMessage) -> Result<HostRequest, Refusal> {
        gateway.verify(&message.nonce, message.join.as_ref().unwrap())
    }

    #[test]
    fn host_with_the_token_is_believed_once() {
        let mut gateway = Authenticator::new(TOKEN).unwrap();
        let message = joining(&gateway, TOKEN);
        assert!(!serde_json::to_string(&message).unwrap().contains(TOKEN));
        assert_eq!(verify(&mut gateway, &message), Ok(request()));
        assert!(!verify(&mut gateway, &message).unwrap_err().later, "a replay");
        let next = joining(&gateway, TOKEN);
        assert_eq!(verify(&mut gateway, &next), Ok(request()));
    }

    #[test]
    fn stranger_and_changed_request_are_rejected() {
        let mut gateway = Authenticator::new(TOKEN).unwrap();
        let stranger = joining(&gateway, "another secret of some length");
        assert!(!verify(&mut gateway, &stranger).unwrap_err().later);
        let mut changed = joining(&gateway, TOKEN);
        let join = changed.join.as_mut().unwrap();
        join.request = join.request.replace("\"workers\":2", "\"workers\":3");
        assert!(!verify(&mut gateway, &changed).unwrap_err().later);
        let mut renamed = joining(&gateway, TOKEN);
        renamed.nonce = "0".repeat(NONCE_CHARACTERS);
        assert!(!verify(&mut gateway, &renamed).unwrap_err().later);
        assert!(gateway.answered.is_empty(), "nothing is stored for a stranger");
    }

    /// A new gateway has another challenge, and a challenge expires before many nonces are stored.
    #[test]
    fn replay_to_another_gateway_or_after_the_challenge_has_expired_is_rejected() {
        let mut gateway = Authenticator::new(TOKEN).unwrap();
        let first = joining(&gateway, TOKEN);
        verify(&mut gateway, &first).unwrap();
        let mut next = Authenticator::new(TOKEN).unwrap();
        assert!(verify(&mut next, &first).unwrap_err().later);
        for _ in 1..ANSWERS_MAX {
            let message = joining(&gateway, TOKEN);
            verify(&mut gateway, &message).unwrap();
        }
        assert!(gateway.answered.is_empty());
        assert!(verify(&mut gateway, &first).unwrap_err().later);
    }

    #[test]
    fn host_takes_only_a_proven_answer_to_its_own_message() {
        let gateway = Authenticator::new(TOKEN).unwrap();
        let (key, message) = (join_key(TOKEN), b"a message of this host");
        let answer = HostAnswer::Refused { reason: "full".into(), later: true };
        let (bytes, session) = gateway.answer(message, &answer).unwrap();
        let received = read_answer(&key, message, &bytes).unwrap();
        assert_eq!(received.answer, answer);
        assert_eq!(received.session.bytes(), session.bytes());
        // A replay: the answer to another message.
        assert!(read_answer(&key, b"another message", &bytes).is_none());
        let stranger = Authenticator::new("another secret of some length").unwrap();
        let (forged, _) = stranger.answer(message, &answer).unwrap();
        assert!(read_answer(&key, message, &forged).is_none());
        let text = String::from_utf8(bytes).unwrap();
        let changed = text.replace("full", "null");
        assert!(read_answer(&key, message, changed.as_bytes()).is_none());
        let bare = serde_json::to_vec(&answer).unwrap();
        assert!(read_answer(&key, message, &bare).is_none(), "without a proof");
    }
}
