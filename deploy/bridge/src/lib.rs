//! Stages 4 and 7 of 8 between hosts: workers send their segments to a learner on another host.
//!
//! ```text
//!  learner's host                                    other hosts
//!  learner ◄── queue, one a worker ── gateway ◄──── Zenoh ──── relay ◄── queues ── workers
//!     └── policies, acknowledgements ──► gateway ── Zenoh ────► relay ── the same ──► workers
//! ```
//! A [`relay`] acts as the learner for the workers of its host; the [`gateway`] acts as the
//! workers of all other hosts for the learner. Like a worker, each hop retains the segments that
//! the learner has not acknowledged: `link_sender` at the relay, `link_receiver` at the gateway. So
//! after any process has died, its predecessor in the chain retransmits. [`wire`] and
//! [`host_messages`] define the messages, `congestion_window` limits the data in flight,
//! `policy_sender` sends policies, [`join`] requests places, and `host_registry` leases them.
//!
//! `keys` derives keys from the run's token, [`handshake`] authenticates both ends of a host, and
//! `seal` all their later messages. `link` and `link_config` are the only files that name Zenoh; a
//! build without the feature `zenoh` has `link_absent` in their place.

mod congestion_window;
pub mod gateway;
pub mod handshake;
pub mod host_messages;
mod host_registry;
pub mod join;
pub mod keys;
#[cfg_attr(not(feature = "zenoh"), path = "link_absent.rs")]
mod link;
#[cfg(feature = "zenoh")]
mod link_config;
mod link_mode;
mod link_receiver;
mod link_sender;
mod policy_sender;
pub mod relay;
pub mod seal;
#[cfg(feature = "zenoh")]
mod tls_identity;
#[cfg(feature = "zenoh")]
mod tls_tunnel;
pub mod token;
pub mod wire;

pub use link::Link;
pub use link_mode::{LinkMode, Urgency};

/// Checks that this program was built with workers of other hosts.
///
/// # Errors
/// Wrong use: it was built without the feature `zenoh`; the message has the command that builds it.
pub fn check_available() -> anyhow::Result<()> {
    if cfg!(feature = "zenoh") {
        return Ok(());
    }
    Err(dmprl_run::failure::wrong_use(
        "this program was built without workers of other hosts; build it with them: \
         cargo build --release --features hosts",
    ))
}
