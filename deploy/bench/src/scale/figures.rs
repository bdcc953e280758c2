//! The report of `dmprl bench scale`, as one JSON object.

use dmprl_run::Machine;
use dmprl_shared::config::ExperimentConfig;
use serde_json::{Value, json};

use super::ScaleBench;
use super::feed::FeedWindow;
use super::model::{Bottleneck, Demand, Model, Prediction};
use crate::drain_receiver::Discrepancies;
use crate::statistics::load_average;
use crate::system::SteadyWindow;

/// Numbers of workers for which the model predicts the throughput.
pub(super) const WORKERS: [usize; 7] = [16, 32, 64, 128, 256, 512, 1_024];

/// Result of the simulation of a learner's ingest.
#[derive(Debug, Clone)]
pub(super) struct Simulated {
    pub(super) window: FeedWindow,
    /// Processor time of the feeders [s].
    pub(super) feeders_cpu_s: Option<f64>,
    pub(super) discrepancies: Discrepancies,
    /// Processor time of an insertion without transport [s].
    pub(super) insert_s: f64,
}

impl Simulated {
    pub(super) fn segments_per_s(&self) -> f64 {
        self.window.total() as f64 / self.window.seconds
    }

    /// Returns the fraction of a core that the learner's thread used.
    pub(super) fn learner_cores(&self) -> f64 {
        self.window.cpu_s / self.window.seconds
    }

    /// Returns the processor time of the learner's thread per segment [s].
    pub(super) fn cpu_s(&self) -> f64 {
        self.window.cpu_s / self.window.total().max(1) as f64
    }

    /// Returns the minimum and maximum of the workers' segments divided by an equal share.
    pub(super) fn shares(&self) -> (f64, f64) {
        let equal = self.window.total() as f64 / self.window.segments.len().max(1) as f64;
        let shares = self.window.segments.iter().map(|&segments| segments as f64 / equal);
        shares.fold((f64::INFINITY, 0.0), |(least, most), it| (it.min(least), it.max(most)))
    }

    /// Jain's fairness index (sum of x)^2 / (n sum of x^2) (Jain et al. 1984): 1 if all workers
    /// have equal shares, 1/n if one worker has everything.
    pub(super) fn jain_index(&self) -> f64 {
        let segments = || self.window.segments.iter().map(|&segments| segments as f64);
        let (sum, squares) = (segments().sum::<f64>(), segments().map(|it| it * it).sum::<f64>());
        sum * sum / (self.window.segments.len().max(1) as f64 * squares.max(1.0))
    }

    /// Resident memory of the learner at the start, in the middle and at the end [MB].
    pub(super) fn resident_mb(&self) -> [Option<f64>; 3] {
        self.window.resident_bytes.map(|bytes| bytes.map(|bytes| bytes as f64 / 1e6))
    }
}

/// Measured cost of each part [s].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CostFigures {
    pub(super) worker_s: f64,
    /// Ingest including transport.
    pub(super) ingest_s: f64,
    /// Ingest without transport: check, settle, insert.
    pub(super) insert_s: f64,
    /// Additional cost of delivery level `log`.
    pub(super) log_s: f64,
    pub(super) update_s: f64,
    pub(super) update_cpu_s: f64,
}

impl CostFigures {
    /// Cost of the queues between processes in the learner: ingest minus insertion.
    pub(super) fn transport_s(&self) -> f64 {
        (self.ingest_s - self.insert_s).max(0.0)
    }
}

/// Comparison of a real system with the model.
#[derive(Debug, Clone, Copy)]
pub(super) struct Check {
    pub(super) predicted: Prediction,
    pub(super) measured_steps_per_s: f64,
    /// Processor time of workers and learner per step, as predicted by the model [s].
    pub(super) predicted_cpu_s: f64,
    /// Processor time of workers and learner per step, as measured [s].
    pub(super) measured_cpu_s: f64,
    /// Cores that workers and learner used.
    pub(super) cores_used: f64,
}

impl Check {
    pub(super) fn new(model: &Model, workers: usize, window: &SteadyWindow) -> Self {
        let steps = (window.last.env_steps - window.first.env_steps).max(1) as f64;
        let cpu_s = window.cpu.learner_s + window.cpu.workers_s;
        Self {
            predicted: model.predict(workers),
            measured_steps_per_s: window.per_s(|line| line.env_steps),
            predicted_cpu_s: model.cpu_s_per_step(),
            measured_cpu_s: cpu_s / steps,
            cores_used: cpu_s / window.seen_s,
        }
    }

    /// Measured divided by predicted throughput.
    pub(super) fn ratio(&self) -> f64 {
        self.measured_steps_per_s / self.predicted.steps_per_s
    }

    /// Measured divided by predicted processor time per step. Other load affects it less than the
    /// throughput.
    pub(super) fn cpu_ratio(&self) -> f64 {
        self.measured_cpu_s / self.predicted_cpu_s
    }

    fn json(&self) -> Value {
        json!({
            "workers": self.predicted.workers,
            "predicted_steps_per_s": self.predicted.steps_per_s,
            "bottleneck": self.predicted.bottleneck,
            "measured_steps_per_s": self.measured_steps_per_s,
            "ratio": self.ratio(),
            "predicted_cpu_us_per_step": 1e6 * self.predicted_cpu_s,
            "measured_cpu_us_per_step": 1e6 * self.measured_cpu_s,
            "cpu_ratio": self.cpu_ratio(),
            "cores_used": self.cores_used,
        })
    }
}

/// All results of the benchmark.
#[derive(Debug, Clone)]
pub struct Figures {
    pub(super) config: ExperimentConfig,
    pub(super) segment_bytes: usize,
    pub(super) feeders: usize,
    pub(super) cores_per_host: usize,
    pub(super) link_bytes_per_s: Option<f64>,
    pub(super) machine: Machine,
    load_average: Option<f64>,
    pub(super) simulated: Simulated,
    pub(super) costs: CostFigures,
    pub(super) model: Model,
    pub(super) checks: Vec<Check>,
}

impl Figures {
    pub(super) fn new(
        bench: &ScaleBench,
        simulated: Simulated,
        costs: CostFigures,
        model: Model,
        checks: Vec<Check>,
        machine: Machine,
    ) -> Self {
        Self {
            config: bench.config.clone(),
            segment_bytes: bench.segment_bytes,
            feeders: bench.feeders,
            cores_per_host: bench.cores_per_host,
            link_bytes_per_s: bench.link_bytes_per_s,
            machine,
            load_average: load_average(),
            simulated,
            costs,
            model,
            checks,
        }
    }

    /// Returns the model's predictions for [`WORKERS`].
    pub(super) fn predictions(&self) -> [Prediction; WORKERS.len()] {
        WORKERS.map(|workers| self.model.predict(workers))
    }

    /// Returns the first bottleneck and the number of workers that reach it.
    pub(super) fn first_bottleneck(&self) -> (Bottleneck, usize) {
        self.model.first_bottleneck()
    }

    /// Returns the figures as one JSON object. Unavailable ones are null.
    #[must_use]
    pub fn json(&self) -> Value {
        let Self { simulated, costs, model, .. } = self;
        let Discrepancies { rejected, duplicate, lost, received } = simulated.discrepancies;
        let (share_min, share_max) = simulated.shares();
        let [start_mb, middle_mb, end_mb] = simulated.resident_mb();
        let (bottleneck, workers) = self.first_bottleneck();
        let Demand { steps_per_segment, updates_per_segment, segment_bytes } = model.demand;
        json!({
            "segments_per_s": simulated.segments_per_s(),
            "segment_bytes": self.segment_bytes,
            "workers": simulated.window.segments.len(),
            "feeders": self.feeders,
            "seconds": simulated.window.seconds,
            "jain_index": simulated.jain_index(),
            "share_min": share_min,
            "share_max": share_max,
            "rss_start_mb": start_mb,
            "rss_middle_mb": middle_mb,
            "rss_end_mb": end_mb,
            "lost": lost,
            "duplicate": duplicate,
            "rejected": rejected,
            "received": received,
            "learner_cores": simulated.learner_cores(),
            "feeders_cores":
                simulated.feeders_cpu_s.map(|seconds| seconds / simulated.window.seconds),
            "ingest_cpu_us": 1e6 * simulated.cpu_s(),
            "insert_cpu_us": 1e6 * simulated.insert_s,
            "insert_to_ingest": simulated.insert_s / simulated.cpu_s(),
            "costs": {
                "worker_us": 1e6 * costs.worker_s,
                "transport_us": 1e6 * costs.transport_s(),
                "insert_us": 1e6 * costs.insert_s,
                "ingest_us": 1e6 * costs.ingest_s,
                "log_us": 1e6 * costs.log_s,
                "update_us": 1e6 * costs.update_s,
                "update_cpu_us": 1e6 * costs.update_cpu_s,
                "segment_bytes": segment_bytes,
                "steps_per_segment": steps_per_segment,
                "updates_per_segment": updates_per_segment,
            },
            "model": self.predictions(),
            "first_bottleneck": { "name": bottleneck, "workers": workers },
            "check": self.checks.iter().map(Check::json).collect::<Vec<_>>(),
            "cores_per_host": self.cores_per_host,
            "learner_cores_max": self.config.learner.threads,
            "link_bytes_per_s": self.link_bytes_per_s,
            "task": self.config.task.name,
            "algorithm": self.config.algorithm.name,
            "policy": self.config.policy.kind,
            "envs_per_worker": self.config.actors.envs_per_worker,
            "cpu": self.machine.cpu,
            "cores": self.machine.cores,
            "load_average": self.load_average,
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use dmprl_learner::metrics::MetricsLine;
    use dmprl_shared::config::Limits;

    use super::*;
    use crate::scale::model::{Costs, Topology};
    use crate::system::CpuTime;

    fn line(env_steps: u64, wall_s: f64) -> MetricsLine {
        let text = r#"{"env_steps":0,"updates":0,"segments":0,"policy_version":1,
            "replay_segments":0,"samples_per_insert":0.0,"rejected":{"layout_version":0,"run":0,
            "architecture":0,"sizes":0,"field":0,"checksum":0,"value":0,"duplicate":0},"lost":0,
            "episodes":0,"updates_owed":0.0,"wall_s":0.0,"env_steps_per_s":0.0,
            "updates_per_s":0.0}"#;
        let line: MetricsLine = serde_json::from_str(text).unwrap();
        MetricsLine { env_steps, wall_s, ..line }
    }

    /// Two workers, one with three quarters of all segments, and round numbers as costs.
    pub(in super::super) fn figures() -> Figures {
        let costs = CostFigures {
            worker_s: 1e-3,
            ingest_s: 3e-6,
            insert_s: 2e-6,
            log_s: 1e-6,
            update_s: 5e-3,
            update_cpu_s: 5e-3,
        };
        let model = Model {
            costs: Costs { worker_s: 1e-3, ingest_s: 3e-6, update_s: 5e-3, update_cpu_s: 5e-3 },
            demand: Demand {
                steps_per_segment: 5.0,
                updates_per_segment: 0.0,
                segment_bytes: 1_024,
            },
            topology: Topology::Hosts { cores_per_host: 16, link_bytes_per_s: None },
        };
        let here = Model { topology: Topology::OneMachine { cores: 2.0 }, ..model };
        let cpu = CpuTime { learner_s: 0.03, workers_s: 9.0, others_s: 0.0 };
        let (first, last) = (line(1_000, 2.0), line(41_000, 12.0));
        let window = SteadyWindow { first, last, lags: Vec::new(), cpu, seen_s: 10.0 };
        let megabytes = |mb: u64| Some(mb * 1_000_000);
        Figures {
            config: ExperimentConfig::default().resolve(Limits { cores: 2 }).unwrap(),
            segment_bytes: 1_024,
            feeders: 2,
            cores_per_host: 16,
            link_bytes_per_s: None,
            machine: Machine { os: "linux".into(), cpu: None, cores: 2, memory_bytes: None },
            load_average: None,
            simulated: Simulated {
                window: FeedWindow {
                    seconds: 2.0,
                    segments: vec![300_000, 100_000],
                    cpu_s: 1.0,
                    resident_bytes: [megabytes(200), megabytes(201), megabytes(201)],
                },
                feeders_cpu_s: Some(2.0),
                discrepancies: Discrepancies { received: 500_000, ..Discrepancies::default() },
                insert_s: 2e-6,
            },
            costs,
            model,
            checks: vec![Check::new(&here, 1, &window)],
        }
    }

    #[test]
    fn json_has_simulation_shares_model_and_check() {
        let json = figures().json();
        let close = |value: &Value, expected: f64| {
            let got = value.as_f64().unwrap();
            assert!((got - expected).abs() < 1e-9 * expected.abs().max(1.0), "{got}: {expected}");
        };
        close(&json["segments_per_s"], 200_000.0);
        close(&json["share_min"], 0.5);
        close(&json["share_max"], 1.5);
        // (3 + 1)^2 / (2 (9 + 1)).
        close(&json["jain_index"], 0.8);
        close(&json["rss_end_mb"], 201.0);
        close(&json["learner_cores"], 0.5);
        close(&json["ingest_cpu_us"], 2.5);
        close(&json["costs"]["transport_us"], 1.0);
        let row = &json["model"][6];
        assert_eq!((&row["workers"], &row["hosts"]), (&1_024.into(), &65.into()));
        assert_eq!(json["first_bottleneck"]["name"], "ingest");
        assert_eq!(json["first_bottleneck"]["workers"], 334);
        let check = &json["check"][0];
        // The system does 4,000 steps per second; the model predicts 5,000 for one worker.
        close(&check["predicted_steps_per_s"], 5_000.0);
        close(&check["ratio"], 0.8);
        close(&check["measured_cpu_us_per_step"], 225.75);
        close(&check["cores_used"], 0.903);
    }
}
