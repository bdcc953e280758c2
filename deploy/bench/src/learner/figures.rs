//! The report of `dmprl bench learner`: one JSON object for programs, a table for people.

use dmprl_run::{Machine, Manifest};
use dmprl_shared::config::{Device, ExperimentConfig};
use dmprl_supervisor::gpus;
use serde_json::{Map, Value, json};

use super::{LearnerBench, PeerKind};
use crate::statistics::{load_average, max, median, min};

/// Name of the learner's own update in the report.
pub(super) const OURS: &str = "ours";
/// Name of the matrix products with the `gemm` crate.
pub(super) const LIBRARY: &str = "floor_library";
/// Name of the matrix products with the learner's kernels.
pub(super) const KERNELS: &str = "floor_kernels";
/// Name of as many multiplications and additions as the products have, on registers.
pub(super) const LIMIT: &str = "limit";
/// Name of a cache line's way from one core to another.
pub(super) const HANDOVER: &str = "handover";
/// Name of sampling a batch.
pub(super) const SAMPLE: &str = "sample";
/// Name of the optimiser and the target networks.
pub(super) const OPTIMISER: &str = "optimiser";

/// Duration of one update, or of a part of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Timed {
    /// Wall time \[s\].
    pub(crate) wall_s: f64,
    /// Processor time of all threads \[s\]. Other programs affect it less than wall time.
    pub(crate) cpu_s: f64,
}

impl Timed {
    /// Divides both times by `count`.
    pub(crate) fn over(self, count: f64) -> Self {
        Self { wall_s: self.wall_s / count, cpu_s: self.cpu_s / count }
    }
}

/// Times of each round, with further figures.
#[derive(Debug, Clone)]
pub struct Figures {
    pub(super) config: ExperimentConfig,
    pub(super) seconds: f64,
    observation_len: usize,
    /// Steps in the replay.
    pub(super) replay_steps: usize,
    machine: Option<Machine>,
    /// Name, memory and driver of the GPUs, if the update runs on one.
    pub(super) gpu: Option<String>,
    load_average: Option<f64>,
    /// (name, rounds) of each available candidate.
    rounds: Vec<(&'static str, Vec<Timed>)>,
    /// (name, description or reason why it is unavailable).
    pub(super) notes: Vec<(&'static str, String)>,
    /// Peak resident memory of the learner, including its replay.
    pub(super) peak_memory_bytes: Option<u64>,
}

impl Figures {
    pub(super) fn new(bench: &LearnerBench) -> Self {
        Self {
            config: bench.config.clone(),
            seconds: bench.duration.as_secs_f64(),
            observation_len: bench.spec.observation_len,
            replay_steps: 0,
            machine: Manifest::new(None).ok().map(|manifest| manifest.machine),
            gpu: (bench.config.learner.device == Device::Cuda).then(gpus).flatten(),
            load_average: load_average(),
            rounds: Vec::new(),
            notes: Vec::new(),
            peak_memory_bytes: None,
        }
    }

    /// Adds a round of `name`.
    pub(super) fn add(&mut self, name: &'static str, timed: Timed) {
        match self.rounds.iter_mut().find(|(known, _)| *known == name) {
            Some((_, rounds)) => rounds.push(timed),
            None => self.rounds.push((name, vec![timed])),
        }
    }

    /// Adds a description of `name`, or the reason why it is unavailable.
    pub(super) fn note(&mut self, name: &'static str, text: &str) {
        self.notes.push((name, text.to_owned()));
    }

    fn rounds(&self, name: &str) -> &[Timed] {
        let rounds = self.rounds.iter().find(|(known, _)| *known == name);
        rounds.map_or(&[], |(_, rounds)| rounds)
    }

    /// Returns the name of the processor.
    pub(super) fn cpu(&self) -> Option<&str> {
        self.machine.as_ref()?.cpu.as_deref()
    }

    pub(super) fn rounds_len(&self) -> usize {
        self.rounds(OURS).len()
    }

    /// Returns the wall time of an update in each round [ms].
    pub(super) fn all_ms(&self, name: &str) -> Vec<f64> {
        self.rounds(name).iter().map(|timed| 1e3 * timed.wall_s).collect()
    }

    pub(super) fn ms(&self, name: &str) -> Option<f64> {
        median(&self.all_ms(name))
    }

    pub(super) fn cpu_ms(&self, name: &str) -> Option<f64> {
        median(&self.rounds(name).iter().map(|timed| 1e3 * timed.cpu_s).collect::<Vec<_>>())
    }

    /// Returns the name of the implementation of the products that is faster over all rounds.
    pub(super) fn floor(&self) -> &'static str {
        let kernels = self.ms(KERNELS) < self.ms(LIBRARY);
        if kernels { KERNELS } else { LIBRARY }
    }

    /// The time of `a` divided by that of `b`: the median of the ratios in each round, because the
    /// machine's speed drifts less within a round than between rounds.
    pub(super) fn ratio(&self, a: &str, b: &str, of: impl Fn(&Timed) -> f64) -> Option<f64> {
        let pairs = self.rounds(a).iter().zip(self.rounds(b));
        median(&pairs.map(|(a, b)| of(a) / of(b)).collect::<Vec<_>>())
    }

    /// Wall time of `name` divided by that of the learner's update.
    pub(super) fn ratio_to_ours(&self, name: &str) -> Option<f64> {
        self.ratio(name, OURS, |timed| timed.wall_s)
    }

    /// (part, its share of an update). Each part is measured alone. The rest consists of activation
    /// functions, DMP, losses, noise and thread synchronisation. `None` if the update runs on
    /// another device than its parts.
    pub(super) fn shares(&self) -> Option<[(&'static str, f64); 4]> {
        if self.config.learner.device != Device::Cpu {
            return None;
        }
        let sample = self.ratio_to_ours(SAMPLE)?;
        let products = self.ratio_to_ours(self.floor())?;
        let optimiser = self.ratio_to_ours(OPTIMISER)?;
        let rest = 1.0 - sample - products - optimiser;
        Some([("sample", sample), ("products", products), (OPTIMISER, optimiser), ("rest", rest)])
    }

    /// Returns the figures as one JSON object. Unavailable ones are null.
    #[must_use]
    pub fn json(&self) -> Value {
        let floor = self.floor();
        let (ms, batch_size) = (self.ms(OURS), self.config.algorithm.batch_size);
        let updates_per_s = ms.map(|ms| 1e3 / ms);
        let mut object = Map::new();
        for kind in PeerKind::ALL {
            let name = kind.name();
            let key = name.replace('-', "_");
            object.insert(format!("peer_{key}_ms"), self.ms(name).into());
            object.insert(format!("peer_{key}_to_ours"), self.ratio_to_ours(name).into());
        }
        let each = |of: &dyn Fn(&str) -> Value| -> Map<String, Value> {
            self.rounds.iter().map(|(name, _)| ((*name).to_owned(), of(name))).collect()
        };
        let spread = |name: &str| {
            let all = self.all_ms(name);
            json!({ "min": min(&all), "max": max(&all) })
        };
        let notes: Map<_, _> =
            self.notes.iter().map(|(name, text)| ((*name).to_owned(), json!(text))).collect();
        let shares = self
            .shares()
            .map(|shares| shares.into_iter().map(|(part, share)| (part.to_owned(), json!(share))));
        let more = json!({
            "ms_per_update": ms,
            "floor_ms": self.ms(floor),
            "floor": floor.trim_start_matches("floor_"),
            "floor_library_ms": self.ms(LIBRARY),
            "floor_kernels_ms": self.ms(KERNELS),
            "limit_ms": self.ms(LIMIT),
            "handover_ns": self.ms(HANDOVER).map(|ms| 1e6 * ms),
            "share_of_limit": self.ratio_to_ours(LIMIT),
            "ratio_to_floor": self.ratio(OURS, floor, |timed| timed.wall_s),
            "cpu_ratio_to_floor": self.ratio(OURS, floor, |timed| timed.cpu_s),
            "updates_per_s": updates_per_s,
            "samples_per_s": updates_per_s.map(|rate| rate * batch_size as f64),
            "batch_size": batch_size,
            "observation_len": self.observation_len,
            "replay_steps": self.replay_steps,
            "threads": self.config.learner.threads,
            "device": self.config.learner.device,
            "gpu": self.gpu,
            "backend": if self.config.updates_by_graph() { "graph" } else { "kernels" },
            "algorithm": self.config.algorithm.name,
            "policy": self.config.policy.kind,
            "task": self.config.task.name,
            "precision": self.config.learner.precision,
            "critic_layer_norm": self.config.algorithm.critic_layer_norm,
            "share_of_time": shares.map(|shares| shares.collect::<Map<_, _>>()),
            "peak_memory_mb": self.peak_memory_bytes.map(|bytes| bytes as f64 / 1e6),
            "seconds": self.seconds,
            "rounds": each(&|name| self.all_ms(name).into()),
            "spread": each(&spread),
            "cpu_ms_per_update": each(&|name| self.cpu_ms(name).into()),
            "notes": notes,
            "cpu": self.cpu(),
            "cores": self.machine.as_ref().map(|machine| machine.cores),
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
    use dmprl_shared::config::Limits;

    use super::*;

    pub(in super::super) fn figures() -> Figures {
        let config = ExperimentConfig::default().resolve(Limits { cores: 2 }).unwrap();
        let mut figures = Figures {
            config,
            seconds: 0.4,
            observation_len: 10,
            replay_steps: 1_000,
            machine: None,
            gpu: None,
            load_average: None,
            rounds: Vec::new(),
            notes: Vec::new(),
            peak_memory_bytes: Some(50_000_000),
        };
        figures.note("torch", "PyTorch, eager");
        figures.note("jax", "is not installed");
        // The machine is four times slower in the second round, and twice in the third.
        for slow in [1.0, 4.0, 2.0] {
            for (name, ms) in [
                (OURS, 5.0),
                (LIBRARY, 4.5),
                (KERNELS, 4.0),
                (LIMIT, 3.0),
                (SAMPLE, 0.25),
                (OPTIMISER, 0.5),
                ("torch", 8.0),
            ] {
                let wall_s = 1e-3 * ms * slow;
                figures.add(name, Timed { wall_s, cpu_s: 0.5 * wall_s });
            }
        }
        figures
    }

    #[test]
    fn json_has_medians_ratios_shares_and_null_for_absent_peers() {
        let json = figures().json();
        let close = |key: &str, expected: f64| {
            let got = json[key].as_f64().unwrap();
            assert!((got - expected).abs() < 1e-9, "{key}: {got}");
        };
        close("ms_per_update", 10.0);
        close("floor_ms", 8.0);
        close("ratio_to_floor", 1.25);
        close("limit_ms", 6.0);
        close("share_of_limit", 0.6);
        close("cpu_ratio_to_floor", 1.25);
        close("updates_per_s", 100.0);
        close("samples_per_s", 12_800.0);
        close("peer_torch_ms", 16.0);
        close("peer_torch_to_ours", 1.6);
        close("peak_memory_mb", 50.0);
        assert_eq!(json["floor"], "kernels");
        assert_eq!((&json["batch_size"], &json["threads"]), (&128.into(), &2.into()));
        for absent in ["peer_jax_ms", "peer_jax_to_ours"] {
            assert!(json[absent].is_null() && json.get(absent).is_some(), "{absent}");
        }
        assert_eq!(json["notes"]["jax"], "is not installed");
    }

    #[test]
    fn an_update_on_a_gpu_has_no_shares_of_its_parts_on_the_cpu() {
        let mut figures = figures();
        figures.config.learner.device = Device::Cuda;
        let json = figures.json();
        assert!(json["share_of_time"].is_null(), "{json}");
        assert_eq!((&json["device"], &json["backend"]), (&"cuda".into(), &"graph".into()));
        let first = figures.text().lines().next().map(str::to_owned);
        assert!(first.is_some_and(|line| line.ends_with(" · graph · cuda")), "{}", figures.text());
    }

    #[test]
    fn shares_of_an_update_add_up_to_one() {
        let shares = figures().shares().unwrap();
        let expected = [0.05, 0.8, 0.1, 0.05];
        for ((part, got), expected) in shares.iter().zip(expected) {
            assert!((got - expected).abs() < 1e-9, "{part}: {got}");
        }
    }
}
