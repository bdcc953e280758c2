//! The connection between the supervisor and the processes of a run: one JSON object per line over
//! standard input and output, with heartbeats.
//!
//! `messages` is the protocol, `pipe` the end of a role's process. The supervisor's end is in
//! `dmprl-supervisor`, because it is asynchronous.

mod heartbeat;
mod messages;
mod pipe;

pub use dmprl_shared::supervision::{
    Activity, Command, EvaluationRequest, EvaluationRow, HostNow, Progress, Report, WorkersNow,
};
pub use heartbeat::{Pulse, start_heartbeat};
pub use messages::{GROUP_SIGNALS, Greeting, JOIN_SOCKET, JoinAnswer, JoinRequest, Welcome};
pub use pipe::{
    ControlPipe, ORPHAN_LIMIT, ORPHANED_LEARNER_LIMIT, Reporter, detach_standard_streams,
    end_process_after,
};
