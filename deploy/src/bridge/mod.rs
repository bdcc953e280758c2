//! Several hosts: workers send their segments to a learner on another host.
//!
//! ```text
//!  learner's host                                    other hosts
//!  learner ◄── queue, one a worker ── gateway ◄──── Zenoh ──── relay ◄── queues ── workers
//!     └── policies, acknowledgements ──► gateway ── Zenoh ────► relay ── the same ──► workers
//! ```
//! A [`relay`] acts as the learner for the workers of its host; the [`gateway`] acts as the workers
//! of all other hosts for the learner. Like a worker, each hop retains the segments that the
//! learner has not acknowledged: `lane` at the relay, `landing` at the gateway. So after any
//! process has died, its predecessor in the chain retransmits. `wire` defines the messages,
//! `window` limits the data in flight, `feed` sends policies, `seats` assigns places to hosts, and
//! `link` is the only file that names Zenoh.

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
