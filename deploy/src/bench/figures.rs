//! What `dmprl bench rollout` reports: for programs one JSON object, for people a table.

use dmprl_shared::config::{ExperimentConfig, PolicyKind};
use dmprl_shared::spec::EnvSpec;
use serde_json::{Map, Value, json};

use super::rollout::RolloutBench;
use crate::run_directory::Machine;
use crate::terminal::grouped;

/// The worker's name among those of its peers.
pub(super) const WORKER: &str = "worker";
/// Everyone who may be measured, in the order of the report.
const NAMES: [&str; 5] = ["batch", "ceiling", WORKER, "gymnasium", "envpool"];
/// Those that the worker is compared with.
const COMPARED: [&str; 3] = ["ceiling", "gymnasium", "envpool"];

/// Environment steps a second of each, by round, and what else is known.
#[derive(Debug, Clone)]
pub struct Figures {
    config: ExperimentConfig,
    env_id: String,
    seconds: f64,
    machine: Machine,
    load_average: Option<f64>,
    /// (name, rate of each round); no entry for one that is absent.
    rates: Vec<(&'static str, Vec<f64>)>,
    /// (name, what it is or why it is absent).
    notes: Vec<(&'static str, String)>,
    pub(super) workers: WorkerFigures,
}

/// What is known of the workers besides their rate.
#[derive(Debug, Clone, Default)]
pub(super) struct WorkerFigures {
    /// From a worker's start to its first delivered segment, the slowest worker's [s].
    pub(super) first_segment_s: f64,
    /// The most memory that a worker has had at once.
    pub(super) rss_bytes: Option<u64>,
    /// Share of one core that the bench itself took while it drained the queues.
    pub(super) sink_cpu_share: f64,
    /// Segments that did not fit.
    pub(super) rejected: u64,
    /// Segments missing in a sequence.
    pub(super) lost: u64,
}

impl Figures {
    pub(super) fn new(bench: &RolloutBench, spec: &EnvSpec, machine: Machine) -> Self {
        Self {
            config: bench.config.clone(),
            env_id: spec.id.clone(),
            seconds: bench.duration.as_secs_f64(),
            machine,
            load_average: load_average(),
            rates: Vec::new(),
            notes: Vec::new(),
            workers: WorkerFigures::default(),
        }
    }

    /// One more round of `name` [environment steps/s].
    pub(super) fn add(&mut self, name: &'static str, rate: f64) {
        match self.rates.iter_mut().find(|(known, _)| *known == name) {
            Some((_, rates)) => rates.push(rate),
            None => self.rates.push((name, vec![rate])),
        }
    }

    /// What `name` is, or why it is absent.
    pub(super) fn note(&mut self, name: &'static str, text: &str) {
        self.notes.push((name, text.to_owned()));
    }

    fn rates(&self, name: &str) -> Option<&[f64]> {
        self.rates.iter().find(|(known, _)| *known == name).map(|(_, rates)| rates.as_slice())
    }

    fn steps_per_s(&self, name: &str) -> Option<f64> {
        self.rates(name).and_then(median)
    }

    /// The worker's median over that of `name`.
    fn ratio(&self, name: &str) -> Option<f64> {
        Some(self.steps_per_s(WORKER)? / self.steps_per_s(name)?)
    }

    fn policy(&self) -> &'static str {
        match self.config.policy.kind {
            PolicyKind::Dmp => "dmp",
            PolicyKind::Mlp => "mlp",
        }
    }

    /// One object; a figure that is not to be had is null.
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
        let rounds: Map<_, _> =
            self.rates.iter().map(|(name, rates)| ((*name).to_owned(), json!(rates))).collect();
        let spread: Map<_, _> = self
            .rates
            .iter()
            .map(|(name, rates)| {
                ((*name).to_owned(), json!({"min": min(rates), "max": max(rates)}))
            })
            .collect();
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
            "rounds": rounds,
            "spread": spread,
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

    /// The same as a table.
    #[must_use]
    pub fn text(&self) -> String {
        let actors = &self.config.actors;
        let rounds = self.rates(WORKER).map_or(0, <[f64]>::len);
        let mut lines = vec![
            format!(
                "{} ({}) · {} · {} × {} environments · {} steps a segment",
                self.config.task.name,
                self.env_id,
                self.policy(),
                actors.workers,
                actors.envs_per_worker,
                self.config.policy.decision_steps()
            ),
            format!(
                "median of {rounds} rounds of {} s; microseconds are of one worker",
                self.seconds
            ),
            String::new(),
            format!(
                "  {:<10} {:>11} {:>9}   {:<21} worker is",
                "", "steps/s", "µs/step", "from … to"
            ),
        ];
        lines.extend(NAMES.iter().map(|name| self.row(name)));
        let WorkerFigures { first_segment_s, rss_bytes, sink_cpu_share, rejected, lost } =
            &self.workers;
        let memory = rss_bytes.map_or_else(
            || "unknown".to_owned(),
            |bytes| format!("{:.0} MB at most", bytes as f64 / 1e6),
        );
        lines.extend([
            String::new(),
            format!("  first segment after {first_segment_s:.2} s; resident memory {memory}"),
            format!("  {rejected} segments rejected, {lost} lost"),
            format!("  draining took {:.1} % of one core", sink_cpu_share * 100.0),
            String::new(),
        ]);
        lines.extend(self.notes.iter().map(|(name, text)| format!("  {name:<10} {text}")));
        lines.join("\n")
    }

    fn row(&self, name: &str) -> String {
        let (Some(rates), Some(rate)) = (self.rates(name), self.steps_per_s(name)) else {
            return format!("  {name:<10} {:>11}", "absent");
        };
        let whole = |rate: f64| grouped(rate.round() as u64);
        let step_us = 1e6 * self.config.actors.workers as f64 / rate;
        let spread = format!("{} … {}", whole(min(rates)), whole(max(rates)));
        let ratio = match self.ratio(name).filter(|_| name != WORKER) {
            Some(ratio) => format!("{ratio:.2} ×"),
            None => String::new(),
        };
        format!("  {name:<10} {:>11} {step_us:>9.2}   {spread:<21} {ratio}", whole(rate))
            .trim_end()
            .to_owned()
    }
}

/// Processes that wanted a processor over the last minute; none where the system does not say.
fn load_average() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/loadavg").ok()?;
    text.split_whitespace().next()?.parse().ok()
}

/// The middle value, or the mean of the two in the middle; none of none.
fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => None,
        len if len.is_multiple_of(2) => Some(0.5 * (sorted[middle - 1] + sorted[middle])),
        _ => Some(sorted[middle]),
    }
}

fn min(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::INFINITY, f64::min)
}

fn max(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_the_middle_whatever_the_order_and_however_far_the_rest() {
        assert_eq!(median(&[]), None);
        assert_eq!(median(&[3.0]), Some(3.0));
        assert_eq!(median(&[1e9, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0, -1e9, 2.0]), Some(1.5));
    }

    fn figures() -> Figures {
        let machine =
            Machine { os: "linux".into(), cpu: None, cores: 2, memory_bytes: Some(1 << 30) };
        let config = ExperimentConfig::default();
        let mut figures = Figures {
            config: config.resolve(dmprl_shared::config::Limits { cores: 3 }).unwrap(),
            env_id: "Reacher-v5".into(),
            seconds: 1.0,
            machine,
            load_average: None,
            rates: Vec::new(),
            notes: Vec::new(),
            workers: WorkerFigures { rss_bytes: Some(50_000_000), ..WorkerFigures::default() },
        };
        figures.note("envpool", "is not installed");
        for rates in [[100.0, 80.0], [400.0, 380.0], [200.0, 180.0]] {
            figures.add("ceiling", rates[0]);
            figures.add(WORKER, rates[1]);
        }
        figures
    }

    #[test]
    fn the_object_has_medians_ratios_rounds_and_null_for_what_is_absent() {
        let json = figures().json();
        assert_eq!(json["ceiling_steps_per_s"], 200.0);
        assert_eq!(json["worker_steps_per_s"], 180.0);
        assert_eq!(json["worker_to_ceiling"], 0.9);
        assert_eq!(json["rounds"]["worker"], json!([80.0, 380.0, 180.0]));
        assert_eq!(json["spread"]["ceiling"], json!({"min": 100.0, "max": 400.0}));
        assert_eq!(json["worker_rss_mb"], 50.0);
        for absent in ["envpool_steps_per_s", "gymnasium_steps_per_s", "worker_to_envpool"] {
            assert!(json[absent].is_null() && json.get(absent).is_some(), "{absent}");
        }
        assert_eq!(json["notes"]["envpool"], "is not installed");
    }

    #[test]
    fn the_table_gives_the_time_of_a_step_in_one_worker() {
        let text = figures().text();
        let row = |name: &str| {
            let line = text.lines().find(|line| line.trim_start().starts_with(name)).unwrap();
            line.split_whitespace().skip(1).collect::<Vec<_>>().join(" ")
        };
        // Two workers at 180 steps a second together: 11.1 ms a step in each.
        assert_eq!(row("worker"), "180 11111.11 80 … 380");
        assert_eq!(row("ceiling"), "200 10000.00 100 … 400 0.90 ×");
        assert_eq!(row("envpool"), "absent");
        assert!(text.contains("50 MB at most"), "{text}");
    }
}
