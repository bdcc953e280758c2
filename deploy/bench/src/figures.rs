//! The report of `dmprl bench rollout`: one JSON object for programs, a table for people.

use dmprl_run::Machine;
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;
use serde_json::{Map, Value, json};

use super::numpy_plan::Controls;
use super::peers::PANDA_GYM;
use super::rollout::RolloutBench;
use super::round::Round;
use super::statistics::{load_average, max, median, min};

/// Name of the workers in the report.
pub(super) const WORKER: &str = "worker";
/// Name of one of several workers, measured while the others sleep.
pub(super) const ONE_WORKER: &str = "one_worker";
/// All candidates, in the order of the report.
pub(super) const NAMES: [&str; 7] =
    ["mujoco", "ceiling", WORKER, ONE_WORKER, "gymnasium", "envpool", PANDA_GYM];
/// The candidates with which the worker is compared.
const COMPARED: [&str; 6] = ["mujoco", "ceiling", ONE_WORKER, "gymnasium", "envpool", PANDA_GYM];

/// Environment steps per second of each candidate and round, with further figures.
#[derive(Debug, Clone)]
pub struct Figures {
    pub(super) config: ExperimentConfig,
    pub(super) env_id: String,
    pub(super) seconds: f64,
    controls: Controls,
    machine: Machine,
    load_average: Option<f64>,
    /// (name, rounds) of each available candidate.
    rounds: Vec<(&'static str, Vec<Round>)>,
    /// (name, description or reason why it is unavailable).
    pub(super) notes: Vec<(&'static str, String)>,
    pub(super) workers: WorkerFigures,
}

/// Figures of the workers besides their rate.
#[derive(Debug, Clone, Default)]
pub(super) struct WorkerFigures {
    /// Time from start to first delivered segment of the slowest worker [s].
    pub(super) first_segment_s: f64,
    /// Peak resident memory of the largest worker.
    pub(super) rss_bytes: Option<u64>,
    /// Fraction of one core that the benchmark itself used to drain the queues.
    pub(super) sink_cpu_share: f64,
    /// Segments rejected for their content.
    pub(super) rejected: u64,
    /// Segments missing from a sequence.
    pub(super) lost: u64,
}

impl Figures {
    pub(super) fn new(bench: &RolloutBench, spec: &EnvSpec, machine: Machine) -> Self {
        Self {
            config: bench.config.clone(),
            env_id: spec.id.clone(),
            seconds: bench.duration.as_secs_f64(),
            controls: bench.controls,
            machine,
            load_average: load_average(),
            rounds: Vec::new(),
            notes: Vec::new(),
            workers: WorkerFigures::default(),
        }
    }

    /// Adds a round of `name`.
    pub(super) fn add(&mut self, name: &'static str, round: Round) {
        match self.rounds.iter_mut().find(|(known, _)| *known == name) {
            Some((_, rounds)) => rounds.push(round),
            None => self.rounds.push((name, vec![round])),
        }
    }

    /// Adds a description of `name`, or the reason why it is unavailable.
    pub(super) fn note(&mut self, name: &'static str, text: &str) {
        self.notes.push((name, text.to_owned()));
    }

    pub(super) fn rounds(&self, name: &str) -> &[Round] {
        let rounds = self.rounds.iter().find(|(known, _)| *known == name);
        rounds.map_or(&[], |(_, rounds)| rounds)
    }

    pub(super) fn rates(&self, name: &str) -> Vec<f64> {
        self.rounds(name).iter().map(|round| round.steps_per_s).collect()
    }

    /// Processor time per step. Other programs affect it less than wall time.
    pub(super) fn cpu_us_per_step(&self, name: &str) -> Option<f64> {
        let of = |round: &Round| round.cores.map(|cores| 1e6 * cores / round.steps_per_s);
        median(&self.rounds(name).iter().filter_map(of).collect::<Vec<_>>())
    }

    pub(super) fn steps_per_s(&self, name: &str) -> Option<f64> {
        median(&self.rates(name))
    }

    /// The worker's rate divided by that of `name`: the median of the ratios in each round, because
    /// the machine's speed drifts less within a round than between rounds.
    pub(super) fn ratio(&self, name: &str) -> Option<f64> {
        let (worker, other) = (self.rates(WORKER), self.rates(name));
        median(&worker.iter().zip(&other).map(|(a, b)| a / b).collect::<Vec<_>>())
    }

    pub(super) fn policy(&self) -> &'static str {
        self.config.policy.kind.name()
    }

    /// Returns the figures as one JSON object. Unavailable ones are null.
    #[must_use]
    pub fn json(&self) -> Value {
        let WorkerFigures { first_segment_s, rss_bytes, sink_cpu_share, rejected, lost } =
            &self.workers;
        let mut object = Map::new();
        for name in NAMES {
            object.insert(format!("{name}_steps_per_s"), self.steps_per_s(name).into());
        }
        for name in COMPARED {
            object.insert(format!("worker_to_{name}"), self.ratio(name).into());
        }
        let present = || NAMES.into_iter().filter(|name| !self.rounds(name).is_empty());
        let each = |of: &dyn Fn(&str) -> Value| -> Map<String, Value> {
            present().map(|name| (name.to_owned(), of(name))).collect()
        };
        let spread = |name: &str| {
            let rates = self.rates(name);
            json!({ "min": min(&rates), "max": max(&rates) })
        };
        let notes: Map<_, _> =
            self.notes.iter().map(|(name, text)| ((*name).to_owned(), json!(text))).collect();
        let actors = &self.config.actors;
        let more = json!({
            "task": self.config.task.name,
            "env_id": self.env_id,
            "policy": self.policy(),
            "workers": actors.workers,
            "envs_per_worker": actors.envs_per_worker,
            "segment_steps": self.config.policy.decision_steps(),
            "queue_segments": actors.queue_segments,
            "seconds": self.seconds,
            "controls": self.controls,
            "rounds": each(&|name| self.rates(name).into()),
            "spread": each(&spread),
            "cpu_us_per_step": each(&|name| self.cpu_us_per_step(name).into()),
            "first_segment_s": first_segment_s,
            "worker_rss_mb": rss_bytes.map(|bytes| bytes as f64 / 1e6),
            "sink_cpu_share": sink_cpu_share,
            "rejected": rejected,
            "lost": lost,
            "notes": notes,
            "cpu": self.machine.cpu,
            "cores": self.machine.cores,
            "load_average": self.load_average,
        });
        if let Value::Object(more) = more {
            object.extend(more);
        }
        Value::Object(object)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) fn figures() -> Figures {
        let machine =
            Machine { os: "linux".into(), cpu: None, cores: 2, memory_bytes: Some(1 << 30) };
        let config = ExperimentConfig::default();
        let mut figures = Figures {
            config: config.resolve(dmprl_shared::config::Limits { cores: 3 }).unwrap(),
            env_id: "Reacher-v5".into(),
            seconds: 1.0,
            controls: Controls::Policy,
            machine,
            load_average: None,
            rounds: Vec::new(),
            notes: Vec::new(),
            workers: WorkerFigures { rss_bytes: Some(50_000_000), ..WorkerFigures::default() },
        };
        figures.note("envpool", "is not installed");
        for [ceiling, worker] in [[100.0, 80.0], [400.0, 380.0], [200.0, 180.0]] {
            figures.add("ceiling", Round { steps_per_s: ceiling, cores: Some(2.0) });
            figures.add(WORKER, Round { steps_per_s: worker, cores: None });
        }
        figures
    }

    #[test]
    fn json_has_medians_ratios_rounds_and_null_for_absent_peers() {
        let json = figures().json();
        assert_eq!(json["ceiling_steps_per_s"], 200.0);
        assert_eq!(json["worker_steps_per_s"], 180.0);
        assert_eq!(json["worker_to_ceiling"], 0.9);
        assert_eq!(json["rounds"]["worker"], json!([80.0, 380.0, 180.0]));
        assert_eq!(json["spread"]["ceiling"], json!({"min": 100.0, "max": 400.0}));
        assert_eq!(json["cpu_us_per_step"], json!({"ceiling": 10_000.0, "worker": null}));
        assert_eq!(json["worker_rss_mb"], 50.0);
        for absent in ["envpool_steps_per_s", "gymnasium_steps_per_s", "worker_to_envpool"] {
            assert!(json[absent].is_null() && json.get(absent).is_some(), "{absent}");
        }
        assert_eq!(json["notes"]["envpool"], "is not installed");
    }
}
