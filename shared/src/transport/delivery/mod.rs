//! Segments that arrive once: kept by the worker until the learner has them for good.
//!
//! ```text
//!   worker                                    learner
//!   put ─► outbox ─► queue ─────────────────► inbox ─► replay ─► checkpoint ┐
//!             ▲                                 │         └─► log ──────────┤ (level "log")
//!             └────── acknowledgements ◄────────┴───────── marks ◄──────────┘
//! ```
//! A queue in shared memory dies with its learner. So the worker's [`Outbox`] keeps every segment
//! that is not acknowledged, and offers all of them again, oldest first, whenever a new connection
//! was made. The learner's [`Inbox`] knows of each worker the last one it has, refuses what comes
//! twice and says how far what came is safe. These [`Mark`]s are part of a checkpoint, from the
//! same moment as the replay.
//!
//! What "safe" means is the level's. `memory`: in the replay; a learner that dies loses what came
//! after its last checkpoint, and nothing else. `log`: in the [`SegmentLog`] too, which a learner
//! that starts reads after the checkpoint; its death loses nothing. Neither survives the worker's
//! own death for what it had not sent, nor a power failure.
//!
//! Nothing here waits or knows the time: the same code runs in a simulation under faults
//! (`shared/tests/delivery_simulation.rs`).

mod inbox;
mod log;
mod outbox;

use serde::{Deserialize, Serialize};

pub use inbox::Inbox;
pub use log::{LogError, Replayed, SegmentLog};
pub use outbox::{Outbox, Sent};

/// The last segment of a worker up to which all are settled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mark {
    /// Which start of the worker.
    pub incarnation: u32,
    /// Its sequence number; 0 before the first.
    pub sequence: u64,
}

/// What a learner tells its workers: cumulative, so that only the newest matters.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Acknowledgements {
    /// Counts the learners of a run's session.
    pub epoch: u64,
    /// Of each worker.
    pub marks: Vec<Mark>,
}
