//! Estimates of the methods' measures, which the rules compare.

use std::cell::RefCell;
use std::collections::BTreeMap;

use dmprl_run::format::grouped;

use super::statement::{Limits, PROPOSED};
use super::verdict::{EPISODES_MIN, SEEDS_MIN, Verdict};
use crate::report::measures::Measure;
use crate::report::provenance::SoftwareCounts;
use crate::report::results::Results;
use crate::report::run::Run;
use crate::report::statistics::{INTERVAL_SCORES_MIN, Summary, median_with_bounds};
use crate::report::thresholds::threshold;

/// Estimate over the seeds of a method.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    /// Number of seeds.
    pub(super) count: usize,
    pub(super) point: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Estimate {
    /// Returns interquartile mean and interval, or mean and range for fewer than four seeds; `None`
    /// without scores.
    pub(super) fn of(scores: &[f64]) -> Option<Self> {
        let summary = Summary::of(scores)?;
        let (point, [low, high]) = summary.point_and_bounds();
        Some(Self { count: summary.count, point, low, high })
    }

    pub(super) fn text(&self, digits: usize) -> String {
        let Self { count, point, low, high } = self;
        let range = self.range_word();
        format!("{point:.digits$} {range}[{low:.digits$}, {high:.digits$}], {count} seeds")
    }

    /// Returns the word before the bounds if they are the range of the seeds.
    fn range_word(&self) -> &'static str {
        if self.count < INTERVAL_SCORES_MIN { "range " } else { "" }
    }
}

/// Formats `26,000`, or that a threshold was not reached.
fn steps_text(steps: f64) -> String {
    if steps.is_finite() { grouped(steps.round() as u64) } else { "not reached".to_owned() }
}

/// The results with a cache of estimates, because each of them needs a bootstrap.
pub(super) struct Estimates<'r> {
    results: &'r Results,
    known: RefCell<BTreeMap<(Measure, String, String), Option<Estimate>>>,
}

impl<'r> Estimates<'r> {
    pub(super) fn new(results: &'r Results) -> Self {
        Self { results, known: RefCell::default() }
    }
}

/// Evaluates one statement: its task, and the method that represents the paper's.
pub(super) struct Context<'e> {
    pub(super) estimates: &'e Estimates<'e>,
    pub(super) limits: Limits,
    pub(super) task: &'e str,
    pub(super) subject: &'e str,
}

impl Context<'_> {
    /// Returns the method's label in the results.
    pub(super) fn label<'n>(&'n self, method: &'n str) -> &'n str {
        if method == PROPOSED { self.subject } else { method }
    }

    pub(super) fn runs<'r>(&'r self, method: &'r str) -> Vec<&'r Run> {
        self.estimates.results.of(self.task, self.label(method)).collect()
    }

    /// Returns the measure that decides whether the task is learnt.
    pub(super) fn learning_measure(&self) -> Measure {
        threshold(self.task).map_or(Measure::Return, |threshold| threshold.measure)
    }

    /// Returns the verdict on missing data of a method, of which `count` scores are known; `None`
    /// if it has enough.
    pub(super) fn missing_data(&self, method: &str, count: usize) -> Option<Verdict> {
        let is_short = |run: &&Run| run.final_episodes.is_none_or(|count| count < EPISODES_MIN);
        match count {
            0 => Some(Verdict::NotRun),
            _ if count < SEEDS_MIN => Some(Verdict::TooFewSeeds),
            _ if self.runs(method).iter().any(is_short) => Some(Verdict::TooFewEpisodes),
            _ => None,
        }
    }

    pub(super) fn estimate(&self, measure: Measure, method: &str) -> Option<Estimate> {
        let key = (measure, self.task.to_owned(), self.label(method).to_owned());
        if let Some(known) = self.estimates.known.borrow().get(&key) {
            return *known;
        }
        let runs = self.runs(method);
        let scores: Vec<f64> = runs.iter().filter_map(|run| measure.of(run)).collect();
        let estimate = if measure == Measure::StepsToThreshold {
            // Unfinished runs will need more steps: without them the estimate would be too low.
            (!scores.is_empty() && scores.len() == runs.len()).then(|| {
                let (point, [low, high]) = median_with_bounds(&scores);
                Estimate { count: scores.len(), point, low, high }
            })
        } else {
            Estimate::of(&scores)
        };
        self.estimates.known.borrow_mut().insert(key, estimate);
        estimate
    }

    /// Formats `TD3 -7.89 [-8.40, -7.31], 3 seeds`.
    pub(super) fn figure(&self, measure: Measure, method: &str) -> String {
        let label = self.label(method);
        let runs = self.runs(method);
        let measured = runs.iter().copied().filter(|run| measure.of(run).is_some());
        let mark = SoftwareCounts::of(measured).mark();
        match self.estimate(measure, method) {
            None if runs.is_empty() => format!("{label}: not run"),
            // Of finished runs, only motion can be unknown.
            None if runs.iter().any(|run| run.ended) && measure.is_of_motion() => {
                format!("{label}: not measured")
            }
            None => format!("{label}: not finished"),
            Some(Estimate { low: f64::INFINITY, count, .. }) => {
                format!("{label} not reached, {count} seeds{mark}")
            }
            Some(estimate) if measure == Measure::StepsToThreshold => {
                let [point, low, high] =
                    [estimate.point, estimate.low, estimate.high].map(steps_text);
                let range = estimate.range_word();
                let count = estimate.count;
                format!("{label} {point} {range}[{low} – {high}] steps, {count} seeds{mark}")
            }
            Some(estimate) => format!("{label} {}{mark}", estimate.text(measure.digits())),
        }
    }

    pub(super) fn figures<'m>(
        &self,
        measure: Measure,
        methods: impl IntoIterator<Item = &'m String>,
    ) -> String {
        let figures = methods.into_iter().map(|method| self.figure(measure, method));
        figures.collect::<Vec<_>>().join("; ")
    }
}
