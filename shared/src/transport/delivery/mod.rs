//! Stage 4 of 8, reliable delivery: a worker keeps each segment until the learner has acknowledged
//! it.
//!
//! ```text
//!   worker                                    learner
//!   put ─► outbox ─► queue ─────────────────► inbox ─► replay ─► checkpoint ┐
//!             ▲                                 │         └─► log ──────────┤ (level "log")
//!             └────── acknowledgements ◄────────┴───────── marks ◄──────────┘
//! ```
//! A queue in shared memory is lost when its learner dies. The worker's [`Outbox`] therefore keeps
//! every unacknowledged segment and retransmits all of them, oldest first, after each reconnection.
//! The learner's [`Inbox`] stores the last settled segment of each worker, rejects duplicates and
//! acknowledges settled segments. Its [`Watermark`]s are part of each checkpoint and always match
//! the replay in it.
//!
//! The delivery level decides when a segment is acknowledged:
//! - `memory`: when it is in the replay. A crash of the learner loses the segments since its last
//!   checkpoint.
//! - `log`: when it is also in the [`SegmentLog`], which a restarted learner reads after the
//!   checkpoint. A crash of the learner loses no segment.
//!
//! At both levels, a crash of a worker loses its unsent segments, and a power failure can lose any.
//!
//! This module does not block or read a clock, so the same code runs in a simulation with faults
//! (`shared/tests/delivery_simulation/`).

mod inbox;
mod log;
mod outbox;

use serde::{Deserialize, Serialize};

pub use inbox::Inbox;
pub use log::{LogError, LogIdentity, Replayed, SegmentLog};
pub use outbox::{Outbox, Sent};

/// Position up to which all segments of a worker are settled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Watermark {
    /// Incarnation of the worker, which increases with each restart.
    pub incarnation: u32,
    /// Sequence number of the last settled segment; 0 before the first.
    pub sequence: u64,
}

/// The learner's acknowledgements to its workers. They are cumulative, so each one replaces all
/// earlier ones.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Acknowledgements {
    /// Number of the learner within the domain. A restarted learner has a higher number.
    pub epoch: u64,
    /// One mark per worker.
    pub marks: Vec<Watermark>,
}
