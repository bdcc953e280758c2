//! `dmprl bench`: measures parts of the system and compares them with alternatives.
//!
//! - `rollout` measures the workers of a run. It takes the learner's place for real `dmprl actor`
//!   processes (`workers`, `drain_receiver`) and alternates with Python processes that do the same
//!   work (`peers`, `numpy_plan`). `figures` and `table` form its report.
//! - `learner` compares an update with its matrix products and with other libraries.
//! - `transport` compares the transport of segments with pipes, sockets and Python's queues. Its
//!   workers only send.
//! - `system` measures a complete run.
//! - `agents` compares the time until a policy is good enough with other libraries.
//! - `scale` predicts the throughput of many workers from the cost of each part, and measures a
//!   learner with 256 synthetic workers.
//! - `policy` compares the latency of a policy with other runtimes.
//!
//! Every long wait checks [`dmprl_run::Watch`], so that an interrupt ends the benchmark.

mod adaptive_sleep;
mod agents;
mod child;
mod drain_receiver;
mod figures;
mod learner;
mod numpy_plan;
mod peers;
mod policy;
mod rollout;
mod round;
mod scale;
mod statistics;
mod synthetic_segments;
mod system;
mod table;
mod transport;
mod workers;

use dmprl_run::Progress;

pub use agents::{AgentKind, AgentsBench, Figures as AgentsFigures, agents};
pub use figures::Figures;
pub use learner::{Figures as LearnerFigures, LearnerBench, PeerKind, learner};
pub use numpy_plan::{Controls, NumpyPlan};
pub use policy::{PolicyBench, PolicyFigures, policy};
pub use rollout::{RolloutBench, rollout};
pub use scale::{Figures as ScaleFigures, ScaleBench, SegmentFeederArgs, scale, segment_feeder};
pub use system::{Figures as SystemFigures, SystemBench, system};
pub use transport::{
    Figures as TransportFigures, TransportBench, TransportWorkerArgs, connect, listen, transport,
    transport_worker,
};

/// Reports the start of `round`, counted from 0, to the progress display.
fn announce_round(progress: &dyn Progress, round: usize, rounds: usize) {
    progress.stage(&format!("round {} of {rounds}", round + 1));
    progress.at(round as u64, rounds as u64);
}
