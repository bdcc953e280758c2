//! Keys that both ends derive from the run's token, and keyed hashes with them.
//!
//! A keyed hash proves that its author knows the token, without revealing it: HMAC-SHA256 over the
//! parts of a message, each with its length, so that no two lists of parts have the same hash.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, Mac};
use sha2::Sha256;

/// Length of a key \[bytes\].
pub const KEY_BYTES: usize = 32;

/// A secret key. Keys of different purposes are independent: none reveals another or the token.
#[derive(Clone)]
pub struct Key([u8; KEY_BYTES]);

impl Key {
    /// Derives a key from the run's token.
    #[must_use]
    pub fn from_token(token: &str, purpose: &str) -> Self {
        Self(hash(token.as_bytes(), &[purpose.as_bytes()]).finalize().into_bytes().into())
    }

    /// Derives a key from this one.
    #[must_use]
    pub fn derive(&self, parts: &[&[u8]]) -> Self {
        Self(hash(&self.0, parts).finalize().into_bytes().into())
    }

    /// The key itself.
    #[must_use]
    pub fn bytes(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }

    /// Computes the keyed hash of these parts, as text.
    #[must_use]
    pub fn prove(&self, parts: &[&[u8]]) -> String {
        STANDARD.encode(hash(&self.0, parts).finalize().into_bytes())
    }

    /// Returns true if `proof` is the keyed hash of these parts. Takes the same time wherever the
    /// two differ.
    #[must_use]
    pub fn is_proof(&self, parts: &[&[u8]], proof: &str) -> bool {
        let proof = STANDARD.decode(proof);
        proof.is_ok_and(|proof| hash(&self.0, parts).verify_slice(&proof).is_ok())
    }
}

impl std::fmt::Debug for Key {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Key(secret)")
    }
}

fn hash(key: &[u8], parts: &[&[u8]]) -> Hmac<Sha256> {
    let mut hasher = Hmac::<Sha256>::new_from_slice(key).expect("HMAC takes keys of any length");
    for part in parts {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part);
    }
    hasher
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "a secret of some length";

    /// Expected value: Python 3.13, `hmac.new(token, length + parts, "sha256")`, where the key is
    /// itself such a hash of the purpose.
    #[test]
    fn keyed_hash_is_hmac_sha256() {
        let key = Key::from_token(TOKEN, "join");
        assert_eq!(key.prove(&[b"ab", b"c"]), "XdNVwE2E49+3epTQKbD9ovV1R9RVxjxErhiEo21AH5U=");
    }

    #[test]
    fn proof_holds_for_its_key_and_its_parts_only() {
        let key = Key::from_token(TOKEN, "join");
        let proof = key.prove(&[b"ab", b"c"]);
        assert!(key.is_proof(&[b"ab", b"c"], &proof));
        assert!(!key.is_proof(&[b"a", b"bc"], &proof));
        assert!(!key.is_proof(&[b"ab", b"c"], &proof[4..]));
        assert!(!key.is_proof(&[b"ab", b"c"], "no base64!"));
        for other in [Key::from_token(TOKEN, "x"), Key::from_token("t", "join"), key.derive(&[])] {
            assert!(!other.is_proof(&[b"ab", b"c"], &proof));
        }
        assert_eq!(format!("{key:?}"), "Key(secret)");
    }
}
