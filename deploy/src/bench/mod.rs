//! `dmprl bench`: how fast a part of the system is, beside what else could do the same work.
//!
//! `rollout` measures the workers of a run. It plays the learner for real `dmprl actor` processes
//! (`workers`, `sink`) and, in turn with them, lets processes of `dmprl.bench_rollout` in Python do
//! the same work (`peers`, `numpy_plan`); `figures` and `table` are what comes out. Everything
//! waits in `watch` or in `child`, where an interrupt is seen. `learner` measures an update beside
//! its matrix products and beside other libraries. `transport` measures what carries segments, with
//! workers that only send, beside pipes, sockets and queues of Python. `system` measures a whole
//! run, and `scale` what many workers would do: by a model of what each part costs, and by a
//! learner that 256 synthetic workers feed. `made_up` are the segments of those that only send.

mod child;
mod figures;
mod learner;
mod made_up;
mod nap;
mod numpy_plan;
mod peers;
mod policy;
mod rollout;
mod scale;
mod sink;
mod statistics;
mod system;
mod table;
mod transport;
mod watch;
mod workers;

pub use figures::Figures;
pub use learner::{Figures as LearnerFigures, LearnerBench, PeerKind, learner, spec_of};
pub use numpy_plan::{Controls, NumpyPlan};
pub use policy::{PolicyBench, PolicyFigures, policy};
pub use rollout::{RolloutBench, rollout};
pub use scale::{Figures as ScaleFigures, ScaleBench, SegmentFeederArgs, scale, segment_feeder};
pub use system::{Figures as SystemFigures, SystemBench, system};
pub use transport::{
    Figures as TransportFigures, TransportBench, TransportWorkerArgs, connect, listen, transport,
    transport_worker,
};
pub(crate) use watch::Watch;
