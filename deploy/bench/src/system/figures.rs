//! The report of `dmprl bench system`: one JSON object for programs, a summary for people.

use dmprl_run::Machine;
use dmprl_run::format::grouped;
use dmprl_shared::config::{AlgorithmName, ExperimentConfig};
use serde_json::{Value, json};

use super::SystemBench;
use super::steady::SteadyWindow;
use crate::statistics::load_average;

/// The steady state of a run, with further figures.
#[derive(Debug, Clone)]
pub struct Figures {
    config: ExperimentConfig,
    evaluate: bool,
    window: SteadyWindow,
    machine: Machine,
    load_average: Option<f64>,
}

impl Figures {
    pub(super) fn new(bench: &SystemBench, window: SteadyWindow, machine: Machine) -> Self {
        let load_average = load_average();
        let (config, evaluate) = (bench.config.clone(), bench.evaluate);
        Self { config, evaluate, window, machine, load_average }
    }

    /// Returns the number of cores used by the learner, the workers and other processes.
    fn cores(&self) -> [f64; 3] {
        let cpu = self.window.cpu;
        [cpu.learner_s, cpu.workers_s, cpu.others_s].map(|seconds| seconds / self.window.seen_s)
    }

    /// Returns the utilisation of learner and workers, relative to one core per thread.
    fn utilisations(&self) -> [f64; 2] {
        let [learner, workers, _] = self.cores();
        let most = |threads: usize| threads.min(self.machine.cores).max(1) as f64;
        [learner / most(self.config.learner.threads), workers / most(self.config.actors.workers)]
    }

    /// Returns measured and configured updates per segment, or `None` for an algorithm with its own
    /// pacing.
    fn updates_per_segment(&self) -> Option<(f64, f64)> {
        if self.config.algorithm.name == AlgorithmName::Ndp {
            return None;
        }
        let configured = self.config.pacing.updates_per_segment;
        let measured = self.window.per_s(|line| line.updates) / self.segments_per_s().max(1e-9);
        Some((measured, configured))
    }

    fn segments_per_s(&self) -> f64 {
        self.window.per_s(|line| line.segments)
    }

    /// Returns the median of the lines' median policy lags.
    fn lag_p50(&self) -> Option<u64> {
        let mut medians: Vec<_> = self.window.lags.iter().map(|(median, _)| *median).collect();
        medians.sort_unstable();
        medians.get(medians.len() / 2).copied()
    }

    fn lag_max(&self) -> Option<u64> {
        self.window.lags.iter().map(|(_, max)| *max).max()
    }

    /// Returns the figures as one JSON object. Unavailable ones are null.
    #[must_use]
    pub fn json(&self) -> Value {
        let SteadyWindow { first, last, cpu, .. } = &self.window;
        let ([learner, workers, others], actors) = (self.cores(), &self.config.actors);
        let [learner_utilisation, workers_utilisation] = self.utilisations();
        let pacing = self.updates_per_segment();
        json!({
            "env_steps_per_s": self.window.per_s(|line| line.env_steps),
            "updates_per_s": self.window.per_s(|line| line.updates),
            "samples_per_insert": self.window.samples_per_insert(),
            "policy_lag_p50": self.lag_p50(),
            "policy_lag_max": self.lag_max(),
            "wall_s": self.window.wall_s(),
            "segments_per_s": self.segments_per_s(),
            "excluded": { "wall_s": first.wall_s, "env_steps": first.env_steps },
            "updates_per_segment": pacing.map(|(measured, _)| measured),
            "updates_per_segment_asked": pacing.map(|(_, configured)| configured),
            "updates_owed": last.updates_owed,
            "cpu_s": { "learner": cpu.learner_s, "workers": cpu.workers_s, "others": cpu.others_s },
            "cores_used": { "learner": learner, "workers": workers, "others": others },
            "learner_utilisation": learner_utilisation,
            "workers_utilisation": workers_utilisation,
            "lost": last.lost,
            "rejected": last.rejected.total(),
            "worker_restarts": last.worker_restarts,
            "task": self.config.task.name,
            "algorithm": self.config.algorithm.name,
            "policy": self.config.policy.kind,
            "workers": actors.workers,
            "envs_per_worker": actors.envs_per_worker,
            "segment_steps": self.config.policy.decision_steps(),
            "learner_threads": self.config.learner.threads,
            "evaluated": self.evaluate,
            "cpu": self.machine.cpu,
            "cores": self.machine.cores,
            "load_average": self.load_average,
        })
    }

    /// Returns the figures as lines of text.
    #[must_use]
    pub fn text(&self) -> String {
        let Self { config, window, .. } = self;
        let ([learner, workers, others], last) = (self.cores(), &window.last);
        let [learner_share, workers_share] = self.utilisations();
        let whole = |rate: f64| grouped(rate.round() as u64);
        let lag =
            |lag: Option<u64>| lag.map_or_else(|| "unknown".to_owned(), |lag| lag.to_string());
        let mut lines = vec![
            format!(
                "{} · {:?} · {:?} · {} × {} environments · {} steps per segment · learner on {} \
                 thread{}",
                config.task.name,
                config.algorithm.name,
                config.policy.kind,
                config.actors.workers,
                config.actors.envs_per_worker,
                config.policy.decision_steps(),
                config.learner.threads,
                if config.learner.threads == 1 { "" } else { "s" }
            )
            .to_lowercase(),
            format!(
                "{:.1} s of steady state, after {:.1} s and {} steps of start-up and warm-up",
                window.wall_s(),
                window.first.wall_s,
                grouped(window.first.env_steps)
            ),
            String::new(),
            format!("  environment steps/s   {:>10}", whole(window.per_s(|line| line.env_steps))),
            format!("  updates/s             {:>10.1}", window.per_s(|line| line.updates)),
            format!("  samples per insert    {:>10.2}", window.samples_per_insert()),
        ];
        if let Some((measured, configured)) = self.updates_per_segment() {
            lines.push(format!(
                "  updates per segment   {measured:>10.3}   configured: {configured}"
            ));
        }
        lines.extend([
            format!(
                "  policy lag            {:>10}   versions, median; {} at most",
                lag(self.lag_p50()),
                lag(self.lag_max())
            ),
            String::new(),
            format!("  learner  {learner:>6.2} cores   {:>3.0} % busy", 100.0 * learner_share),
            format!("  workers  {workers:>6.2} cores   {:>3.0} % busy", 100.0 * workers_share),
            format!("  others   {others:>6.2} cores   of {}", self.machine.cores),
            String::new(),
            format!(
                "  {} segments lost, {} rejected, {} worker restarts",
                last.lost,
                last.rejected.total(),
                last.worker_restarts
            ),
        ]);
        lines.join("\n")
    }
}
