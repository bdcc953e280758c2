//! Several hosts: the workers of one send their segments to the learner of another.
//!
//! ```text
//!  learner's host                                    other hosts
//!  learner ◄── queue, one a worker ── gateway ◄──── Zenoh ──── relay ◄── queues ── workers
//!     └── policies, acknowledgements ──► gateway ── Zenoh ────► relay ── the same ──► workers
//! ```
//! To the workers of its host, a [`relay`] is the learner; to the learner, the [`gateway`] is the
//! workers of all other hosts. Each hop keeps what the learner has not acknowledged, as a worker
//! does: `lane` at the relay, `landing` at the gateway. So whoever dies, the one before sends
//! again. `wire` is what they say, `window` how much may be under way, `feed` how policies go,
//! `seats` who has which places, and `link` is the only file that names Zenoh.

mod feed;
pub mod gateway;
pub mod landing;
pub mod lane;
mod link;
pub mod relay;
pub mod seats;
pub mod token;
pub mod window;
pub mod wire;

pub use link::{Ends, Link, Urgency};
