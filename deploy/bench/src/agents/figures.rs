//! The report of `dmprl bench peers`: one JSON object for programs, a table for people.

use dmprl_analysis::report::Summary;
use dmprl_run::format::grouped;
use dmprl_run::{Machine, Progress};
use dmprl_shared::config::ExperimentConfig;
use serde_json::{Map, Value, json};

use super::{AgentKind, AgentsBench, Evaluated, Target, Training};
use crate::statistics::{load_average, max, median, min};

/// Name of our own trainings.
const OURS: &str = "ours";

/// All trainings of each candidate, ours first.
#[derive(Debug, Clone)]
pub struct Figures {
    /// Whether the user stopped the benchmark before its end.
    pub interrupted: bool,
    config: ExperimentConfig,
    equal_settings: bool,
    machine: Machine,
    load_average: Option<f64>,
    candidates: Vec<Candidate>,
}

#[derive(Debug, Clone)]
struct Candidate {
    kind: Option<AgentKind>,
    trainings: Vec<Training>,
    /// Library and version, or why it was not trained.
    note: Option<String>,
}

impl Candidate {
    fn name(&self) -> &'static str {
        self.kind.map_or(OURS, AgentKind::name)
    }

    fn reached(&self) -> usize {
        self.trainings.iter().filter(|training| training.reached).count()
    }

    fn values(&self, value: impl Fn(&Training) -> f64) -> Vec<f64> {
        self.trainings.iter().map(value).collect()
    }

    /// Summary of one result of the last evaluations; `None` if a training has none.
    fn summary(&self, result: impl Fn(&Evaluated) -> Option<f64>) -> Option<Summary> {
        let results = self.trainings.iter().map(|it| it.evaluated.as_ref().and_then(&result));
        Summary::of(&results.collect::<Option<Vec<_>>>()?)
    }

    fn returns(&self) -> Option<Summary> {
        self.summary(|it| Some(it.return_mean))
    }

    fn success_rates(&self) -> Option<Summary> {
        self.summary(|it| it.success_rate)
    }

    /// Median time; `None` if half of the trainings or more did not reach the target, because their
    /// times are unknown.
    fn median_s(&self) -> Option<f64> {
        let time = |it: &Training| if it.reached { it.seconds } else { f64::INFINITY };
        median(&self.values(time)).filter(|median| median.is_finite())
    }
}

impl Figures {
    pub(super) fn new(bench: &AgentsBench, machine: Machine) -> Self {
        let kinds = std::iter::once(None).chain(bench.peers.iter().copied().map(Some));
        let candidate = |kind| Candidate { kind, trainings: Vec::new(), note: None };
        Self {
            interrupted: false,
            config: bench.config.clone(),
            equal_settings: bench.equal_settings,
            machine,
            load_average: load_average(),
            candidates: kinds.map(candidate).collect(),
        }
    }

    /// Adds a training, and prints its result.
    pub(super) fn add(
        &mut self,
        kind: Option<AgentKind>,
        training: Training,
        progress: &dyn Progress,
    ) {
        let name = kind.map_or(OURS, AgentKind::name);
        let value = training.evaluated.map_or_else(|| "no evaluation".to_owned(), described);
        let (seconds, steps) = (training.seconds, grouped(training.env_steps));
        let missed = match training.reached || self.target() == Target::None {
            true => "",
            false => ", target not reached",
        };
        progress.print(&format!("{name}: {value} after {seconds:.1} s and {steps} steps{missed}"));
        if let Some(candidate) = self.candidates.iter_mut().find(|it| it.kind == kind) {
            candidate.trainings.push(training);
        }
    }

    /// Records a peer's description, or why it is unavailable.
    pub(super) fn note(&mut self, kind: AgentKind, text: String) {
        if let Some(candidate) = self.candidates.iter_mut().find(|it| it.kind == Some(kind)) {
            candidate.note = Some(text);
        }
    }

    pub(super) fn has_trainings(&self) -> bool {
        self.candidates.iter().any(|candidate| !candidate.trainings.is_empty())
    }

    fn target(&self) -> Target {
        Target::of(&self.config)
    }

    fn ours_s(&self) -> Option<f64> {
        self.candidates.first().and_then(Candidate::median_s)
    }

    /// Returns the figures as one JSON object. Unavailable ones are null.
    #[must_use]
    pub fn json(&self) -> Value {
        let target = match self.target() {
            Target::Return(value) => json!({ "name": "return", "value": value }),
            Target::Success(value) => json!({ "name": "success", "value": value }),
            Target::None => Value::Null,
        };
        let candidates: Map<_, _> = self
            .candidates
            .iter()
            .map(|candidate| {
                let trainings: Vec<_> = candidate
                    .trainings
                    .iter()
                    .map(|it| {
                        json!({
                            "reached": it.reached, "seconds": it.seconds, "start_s": it.start_s,
                            "evaluation_s": it.evaluation_s, "env_steps": it.env_steps,
                            "evaluated": it.evaluated,
                        })
                    })
                    .collect();
                let ratio = candidate.median_s().zip(self.ours_s()).map(|(it, ours)| it / ours);
                let object = json!({
                    "median_s": candidate.median_s(), "ratio": ratio,
                    "reached": candidate.reached(), "return": candidate.returns(),
                    "success": candidate.success_rates(), "trainings": trainings,
                    "note": candidate.note,
                });
                (candidate.name().to_owned(), object)
            })
            .collect();
        json!({
            "task": self.config.task.name,
            "algorithm": self.config.algorithm.name,
            "policy": self.config.policy.kind,
            "target": target,
            "episodes": self.config.evaluation.episodes,
            "evaluation_interval_steps": self.config.evaluation.interval_steps,
            "max_minutes": self.config.run.max_minutes,
            "steps_max": self.config.run.steps,
            "equal_settings": self.equal_settings,
            "interrupted": self.interrupted,
            "candidates": candidates,
            "cpu": self.machine.cpu,
            "cores": self.machine.cores,
            "load_average": self.load_average,
        })
    }

    /// Returns the figures as a table.
    #[must_use]
    pub fn text(&self) -> String {
        let mut lines = vec![self.title()];
        if self.interrupted {
            lines.push("interrupted: only the trainings that had ended".to_owned());
        }
        let (header, legend) = match self.target() {
            Target::None => (FINAL_HEADER, FINAL_LEGEND),
            Target::Return(_) | Target::Success(_) => (TIME_HEADER, TIME_LEGEND),
        };
        lines.extend([String::new(), header.to_owned()]);
        for candidate in &self.candidates {
            lines.push(match (&candidate.note, self.target()) {
                (_, Target::None) if !candidate.trainings.is_empty() => final_row(candidate),
                _ if !candidate.trainings.is_empty() => self.time_row(candidate),
                (Some(why), _) => format!("  {:<12}absent: {why}", candidate.name()),
                (None, _) => format!("  {:<12}not trained", candidate.name()),
            });
        }
        lines.extend([String::new(), legend.to_owned()]);
        lines.join("\n")
    }

    fn title(&self) -> String {
        let run = &self.config.run;
        let target = match self.target() {
            Target::Return(value) => format!("return of at least {value}"),
            Target::Success(value) => format!("success rate of at least {value}"),
            Target::None => format!("after {} minutes", run.max_minutes),
        };
        format!(
            "{} · {target} · {} episodes · peers with {} · {}, {} cores",
            self.config.task.name,
            self.config.evaluation.episodes,
            if self.equal_settings { "our settings" } else { "their defaults" },
            self.machine.cpu.as_deref().unwrap_or("unknown processor"),
            self.machine.cores
        )
    }

    fn time_row(&self, candidate: &Candidate) -> String {
        let count = candidate.trainings.len();
        let (time, ratio) = match (candidate.median_s(), self.ours_s()) {
            (Some(time), Some(ours)) => (format!("{time:.1}"), format!("{:.1}", time / ours)),
            (Some(time), None) => (format!("{time:.1}"), String::new()),
            (None, _) => ("unknown".to_owned(), String::new()),
        };
        let seconds = candidate.values(|it| it.seconds);
        let middle = |value: fn(&Training) -> f64| median(&candidate.values(value)).unwrap_or(0.0);
        format!(
            "  {:<12}{:>8}  {time:>8}  {:<17}{:>9}{:>8.1}{:>8.1}{ratio:>8}",
            candidate.name(),
            format!("{}/{count}", candidate.reached()),
            format!("({:.1} to {:.1})", min(&seconds), max(&seconds)),
            grouped(middle(|it| it.env_steps as f64) as u64),
            middle(|it| it.start_s.unwrap_or(f64::NAN)),
            middle(|it| it.evaluation_s),
        )
    }
}

const TIME_HEADER: &str =
    "               reached    time s  (range)              steps   start    eval   ratio";
const TIME_LEGEND: &str =
    "time: medians over the seeds, from the start of the process to the target; steps, start (until
the first step) and eval (only evaluation, within time): medians; ratio: time relative to ours";
const FINAL_HEADER: &str =
    "               seeds    return  (interval)             success  (interval)           steps";
const FINAL_LEGEND: &str =
    "return, success: interquartile means over the seeds with 95 % bootstrap intervals (fewer than
four seeds: means with ranges); steps: medians";

fn final_row(candidate: &Candidate) -> String {
    let (success, within) = point_and_bounds(candidate.success_rates());
    let (mean, interval) = point_and_bounds(candidate.returns());
    let steps = median(&candidate.values(|it| it.env_steps as f64)).unwrap_or(0.0);
    format!(
        "  {:<12}{:>6}{mean:>10}  {interval:<24}{success:>6}  {within:<16}{:>9}",
        candidate.name(),
        candidate.trainings.len(),
        grouped(steps as u64),
    )
}

fn point_and_bounds(summary: Option<Summary>) -> (String, String) {
    summary.map_or_else(Default::default, |summary| {
        let (point, [low, high]) = summary.point_and_bounds();
        (format!("{point:.2}"), format!("({low:.2} to {high:.2})"))
    })
}

fn described(evaluated: Evaluated) -> String {
    let success = evaluated.success_rate.map(|rate| format!(", success {rate:.2}"));
    format!("return {:.2}{}", evaluated.return_mean, success.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn training(reached: bool, seconds: f64) -> Training {
        Training {
            reached,
            seconds,
            start_s: Some(1.0),
            evaluation_s: 2.0,
            env_steps: 5000,
            evaluated: None,
        }
    }

    #[test]
    fn a_training_that_misses_the_target_counts_as_longer_than_any_other() {
        let candidate = |trainings| Candidate { kind: None, trainings, note: None };
        let mostly = vec![training(true, 4.0), training(false, 1.0), training(true, 2.0)];
        assert_eq!(candidate(mostly).median_s(), Some(4.0));
        let rarely = vec![training(true, 4.0), training(false, 1.0)];
        assert_eq!(candidate(rarely).median_s(), None);
        assert_eq!(candidate(Vec::new()).median_s(), None);
    }
}
