//! `dmprl bench`: measures parts of the system and compares them with alternatives.
//!
//! `rollout` measures the workers of a run. It acts as the learner for real `dmprl actor` processes
//! (`workers`, `drain_receiver`) and, in turn with them, runs processes of `dmprl.bench_rollout` in
//! Python that do the same work (`peers`, `numpy_plan`). `figures` and `table` are its report. All
//! waiting is in `child` and [`dmprl_run::Watch`], which notice an interrupt. `learner` compares an
//! update with its matrix products and with other libraries. `transport` compares the transport of
//! segments with pipes, sockets and Python's queues; its workers only send. `system` measures a
//! complete run. `scale` predicts the throughput of many workers from the cost of each part, and
//! measures a learner with 256 synthetic workers. `synthetic_segments` generates the synthetic
//! segments.

mod adaptive_sleep;
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

/// Shows the round that begins, counted from 0.
fn announce_round(progress: &dyn Progress, round: usize, rounds: usize) {
    progress.stage(&format!("round {} of {rounds}", round + 1));
    progress.at(round as u64, rounds as u64);
}
