//! Predicts the throughput of many workers from the costs of each part, by pure arithmetic.
//!
//! Four resources limit the number of segments per second. The lowest limit is the bottleneck:
//!
//! ```text
//!   workers   busy workers / worker_s                 one thread each: at most one core
//!   learner   1 / (ingest_s + u update_s)             one thread alternates between segments and
//!                                                     updates; u updates per segment (pacing)
//!   link      link_bytes_per_s / segment_bytes        into the learner's host, if given
//!   cores     cores / (worker_s + ingest_s + u update_cpu_s)     if all share one machine
//! ```
//! The learner's limit is called `ingest` if segments take most of its time, else `updates`.
//!
//! Assumptions, checked against a real system on one machine only:
//! - Costs are constant: a worker's is independent of the number of workers, the learner's of the
//!   number of queues (it is measured with many), and an update's of other load. All cores are
//!   equal and otherwise idle.
//! - Queues are long enough that only the bottleneck makes the other parts wait.
//! - Each worker host has `cores_per_host` workers. The learner has its own host, with a core for
//!   each of its threads.
//! - A network limits only the number of bytes. The gateway's processor time on the learner's host
//!   is not included.
//! - Publishing, metrics, checkpoints and evaluations are free, because they are rare compared with
//!   updates.

use serde::Serialize;

/// Costs of one segment and one update [s].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Costs {
    /// Processor time of a worker per segment.
    pub(super) worker_s: f64,
    /// Time of the learner's thread per segment: to take, check, settle, insert and acknowledge it.
    pub(super) ingest_s: f64,
    /// Wall time of an update on the learner's threads.
    pub(super) update_s: f64,
    /// Processor time of an update, of all threads together.
    pub(super) update_cpu_s: f64,
}

/// Requirements of a run per segment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Demand {
    /// Average number of environment steps per segment.
    pub(super) steps_per_segment: f64,
    /// Updates per segment.
    pub(super) updates_per_segment: f64,
    /// Size of header and block.
    pub(super) segment_bytes: usize,
}

/// Placement of workers and learner on machines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Topology {
    /// Workers and learner share a machine.
    OneMachine {
        /// Number of cores available to them.
        cores: f64,
    },
    /// The learner has its own host; the workers run on other hosts.
    Hosts {
        /// Workers per host.
        cores_per_host: usize,
        /// Bandwidth into the learner's host; `None` for unlimited.
        link_bytes_per_s: Option<f64>,
    },
}

/// The resource that limits a system.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Bottleneck {
    /// The workers, all of which are busy.
    Workers,
    /// The learner's thread, mostly busy taking segments.
    Ingest,
    /// The learner's thread, mostly busy with updates.
    Updates,
    /// The network into the learner's host.
    Link,
    /// The cores of the shared machine.
    Cores,
}

impl Bottleneck {
    /// Returns the bottleneck's name for reports.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Workers => "workers",
            Self::Ingest => "ingest",
            Self::Updates => "updates",
            Self::Link => "link",
            Self::Cores => "cores",
        }
    }
}

/// Predicted throughput with a number of workers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Prediction {
    pub(super) workers: usize,
    /// Number of hosts, including the learner's.
    pub(super) hosts: usize,
    pub(super) steps_per_s: f64,
    pub(super) bottleneck: Bottleneck,
    /// Fraction of time in which the learner's thread is busy.
    pub(super) learner_utilisation: f64,
}

/// The model's parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Model {
    pub(super) costs: Costs,
    pub(super) demand: Demand,
    pub(super) topology: Topology,
}

impl Model {
    /// Time of the learner's thread for a segment and its updates [s].
    fn learner_s(&self) -> f64 {
        self.costs.ingest_s + self.demand.updates_per_segment * self.costs.update_s
    }

    /// Processor time of workers and learner per environment step [s].
    pub(super) fn cpu_s_per_step(&self) -> f64 {
        self.cpu_s() / self.demand.steps_per_segment
    }

    /// Processor time of workers and learner per segment [s].
    fn cpu_s(&self) -> f64 {
        let Costs { worker_s, ingest_s, update_cpu_s, .. } = self.costs;
        worker_s + ingest_s + self.demand.updates_per_segment * update_cpu_s
    }

    /// Segments per second of the workers without any other limit.
    fn workers_rate(&self, workers: usize) -> f64 {
        let busy = match self.topology {
            Topology::OneMachine { cores } => (workers as f64).min(cores),
            Topology::Hosts { .. } => workers as f64,
        };
        busy / self.costs.worker_s
    }

    /// All other limits on segments per second.
    fn other_limits(&self) -> [(Bottleneck, f64); 3] {
        let Self { costs, demand, topology } = self;
        let updates_s = demand.updates_per_segment * costs.update_s;
        let learner =
            if updates_s > costs.ingest_s { Bottleneck::Updates } else { Bottleneck::Ingest };
        let (cores, link) = match *topology {
            Topology::OneMachine { cores } => (cores / self.cpu_s(), None),
            Topology::Hosts { link_bytes_per_s, .. } => (f64::INFINITY, link_bytes_per_s),
        };
        let link = link.map_or(f64::INFINITY, |bytes| bytes / demand.segment_bytes as f64);
        [(learner, 1.0 / self.learner_s()), (Bottleneck::Link, link), (Bottleneck::Cores, cores)]
    }

    /// Predicts the throughput of `workers` workers.
    pub(super) fn predict(&self, workers: usize) -> Prediction {
        let limits = self.other_limits().into_iter();
        let lower = |a: (Bottleneck, f64), b: (Bottleneck, f64)| if b.1 < a.1 { b } else { a };
        let (bottleneck, segments_per_s) =
            limits.fold((Bottleneck::Workers, self.workers_rate(workers)), lower);
        let hosts = match self.topology {
            Topology::OneMachine { .. } => 1,
            Topology::Hosts { cores_per_host, .. } => 1 + workers.div_ceil(cores_per_host.max(1)),
        };
        Prediction {
            workers,
            hosts,
            steps_per_s: segments_per_s * self.demand.steps_per_segment,
            bottleneck,
            learner_utilisation: segments_per_s * self.learner_s(),
        }
    }

    /// Returns the lowest limit besides the workers' own, and the number of workers that reach it.
    pub(super) fn first_bottleneck(&self) -> (Bottleneck, usize) {
        let lower = |a: (Bottleneck, f64), b: (Bottleneck, f64)| if b.1 < a.1 { b } else { a };
        let none = (Bottleneck::Workers, f64::INFINITY);
        let (bottleneck, rate) = self.other_limits().into_iter().fold(none, lower);
        (bottleneck, (rate * self.costs.worker_s).ceil() as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A worker makes 100 segments per second; the learner ingests 10,000 or does 500 updates.
    const COSTS: Costs =
        Costs { worker_s: 1e-2, ingest_s: 1e-4, update_s: 2e-3, update_cpu_s: 2e-3 };
    const DEMAND: Demand =
        Demand { steps_per_segment: 5.0, updates_per_segment: 0.0, segment_bytes: 1_000 };

    fn hosts(costs: Costs, demand: Demand, link_bytes_per_s: Option<f64>) -> Model {
        Model { costs, demand, topology: Topology::Hosts { cores_per_host: 16, link_bytes_per_s } }
    }

    #[track_caller]
    fn close(got: f64, expected: f64) {
        assert!((got / expected - 1.0).abs() < 1e-9, "{got}, expected {expected}");
    }

    #[test]
    fn few_workers_limit_themselves_and_the_learner_idles() {
        let prediction = hosts(COSTS, DEMAND, None).predict(50);
        assert_eq!((prediction.bottleneck, prediction.hosts), (Bottleneck::Workers, 5));
        close(prediction.steps_per_s, 50.0 * 100.0 * 5.0);
        close(prediction.learner_utilisation, 0.5);
    }

    #[test]
    fn without_updates_ingest_is_the_first_bottleneck() {
        let model = hosts(COSTS, DEMAND, None);
        assert_eq!(model.first_bottleneck(), (Bottleneck::Ingest, 100));
        let prediction = model.predict(1_024);
        assert_eq!((prediction.bottleneck, prediction.hosts), (Bottleneck::Ingest, 65));
        close(prediction.steps_per_s, 10_000.0 * 5.0);
        close(prediction.learner_utilisation, 1.0);
    }

    #[test]
    fn updates_and_segments_share_the_learners_time() {
        let demand = Demand { updates_per_segment: 0.2, ..DEMAND };
        let model = hosts(COSTS, demand, None);
        // 0.1 ms to take a segment, 0.4 ms for its updates.
        assert_eq!(model.first_bottleneck(), (Bottleneck::Updates, 20));
        close(model.predict(64).steps_per_s, 2_000.0 * 5.0);
        let rare = Demand { updates_per_segment: 0.01, ..DEMAND };
        assert_eq!(hosts(COSTS, rare, None).predict(1_024).bottleneck, Bottleneck::Ingest);
    }

    #[test]
    fn slow_link_limits_the_learner() {
        let model = hosts(COSTS, DEMAND, Some(1e6));
        assert_eq!(model.first_bottleneck(), (Bottleneck::Link, 10));
        close(model.predict(16).steps_per_s, 1_000.0 * 5.0);
        assert_eq!(hosts(COSTS, DEMAND, Some(1e9)).predict(512).bottleneck, Bottleneck::Ingest);
    }

    #[test]
    fn on_one_machine_learner_and_workers_share_the_cores() {
        let demand = Demand { updates_per_segment: 3.0, ..DEMAND };
        let topology = Topology::OneMachine { cores: 2.0 };
        let model = Model { costs: COSTS, demand, topology };
        // 10 ms of a worker, 6.1 ms of the learner.
        let [one, two, four] = [1, 2, 4].map(|workers| model.predict(workers));
        assert_eq!((one.bottleneck, one.hosts), (Bottleneck::Workers, 1));
        close(one.steps_per_s, 500.0);
        assert_eq!((two.bottleneck, four.bottleneck), (Bottleneck::Cores, Bottleneck::Cores));
        close(two.steps_per_s, 5.0 * 2.0 / 16.1e-3);
        close(two.steps_per_s, four.steps_per_s);
        close(two.learner_utilisation, 2.0 * 6.1 / 16.1);
    }

    /// Two threads halve the wall time of an update but not its processor time.
    #[test]
    fn learner_threads_count_as_cores() {
        let costs = Costs { update_s: 1e-3, ..COSTS };
        let demand = Demand { updates_per_segment: 50.0, ..DEMAND };
        let one_machine = Model { costs, demand, topology: Topology::OneMachine { cores: 2.0 } };
        let prediction = one_machine.predict(2);
        assert_eq!(prediction.bottleneck, Bottleneck::Cores);
        close(prediction.steps_per_s, 5.0 * 2.0 / 110.1e-3);
        let hosts = hosts(costs, demand, None).predict(16);
        assert_eq!(hosts.bottleneck, Bottleneck::Updates);
        close(hosts.steps_per_s, 5.0 / 50.1e-3);
    }
}
