//! Stage 4 of 8, reliable delivery: a worker keeps each segment until the learner has acknowledged
//! it.
//!
//! ```text
//!   worker                                    learner
//!   put ─► outbox ─► queue ─────────────────► inbox ─► replay ─► checkpoint ┐
//!             ▲                                 │         └─► log ──────────┤ (level "log")
//!             └────── acknowledgements ◄────────┴───────── marks ◄──────────┘
//! ```
//! A queue in shared memory dies with its learner. The worker's [`Outbox`] therefore keeps every
//! unacknowledged segment and retransmits all of them, oldest first, after each reconnection. The
//! learner's [`Inbox`] stores the last settled segment of each worker, rejects duplicates and
//! acknowledges settled segments. Its [`Watermark`]s are part of a checkpoint and always match the
//! replay in it.
//!
//! The delivery level decides when a segment is acknowledged. `memory`: when it is in the replay; a
//! learner that dies loses the segments since its last checkpoint. `log`: when it is in the
//! [`SegmentLog`] too, which a restarted learner reads after the checkpoint; its death loses
//! nothing. At neither level do unsent segments survive the death of their worker. A power failure
//! can lose segments at both levels.
//!
//! Nothing here blocks or reads a clock, so the same code runs in a simulation with faults
//! (`shared/tests/delivery_simulation/`).

mod inbox;
mod log;
mod outbox;

use serde::{Deserialize, Serialize};

pub use inbox::Inbox;
pub use log::{LogError, LogIdentity, Replayed, SegmentLog};
pub use outbox::{Outbox, Sent};

/// The last segment of a worker up to which all segments are settled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Watermark {
    /// Number of the worker's start.
    pub incarnation: u32,
    /// Sequence number of the segment; 0 before the first.
    pub sequence: u64,
}

/// The learner's acknowledgements to its workers. They are cumulative: the newest replaces all
/// older ones.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Acknowledgements {
    /// Number of the learner within the domain; a restarted learner has a higher one.
    pub epoch: u64,
    /// One mark per worker.
    pub marks: Vec<Watermark>,
}
