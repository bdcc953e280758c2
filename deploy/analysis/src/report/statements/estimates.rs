//! Estimates the methods' measures over seeds, for comparison by the rules.

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

/// Estimate of a measure over the seeds of a method.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    /// Number of seeds.
    pub(super) count: usize,
    pub(super) point: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Estimate {
    /// Estimates by interquartile mean and interval, or by mean and range with fewer than four
    /// seeds. Returns `None` without scores.
    pub(super) fn of(scores: &[f64]) -> Option<Self> {
        let summary = Summary::of(scores)?;
        let (point, [low, high]) = summary.point_and_bounds();
        Some(Self { count: summary.count, point, low, high })
    }

    /// Formats `-7.89 [-8.40, -7.31], 5 seeds`.
    pub(super) fn text(&self, digits: usize) -> String {
        let Self { count, point, low, high } = self;
        let range = self.range_word();
        format!("{point:.digits$} {range}[{low:.digits$}, {high:.digits$}], {count} seeds")
    }

    /// Returns the word before the bounds: `range ` if they are the range over the seeds.
    fn range_word(&self) -> &'static str {
        if self.count < INTERVAL_SCORES_MIN { "range " } else { "" }
    }
}

/// Formats `26,000`, or `not reached` if infinite.
fn steps_text(steps: f64) -> String {
    if steps.is_finite() { grouped(steps.round() as u64) } else { "not reached".to_owned() }
}

/// The results with a cache of estimates, since each estimate needs a bootstrap.
pub(super) struct Estimates<'r> {
    results: &'r Results,
    cache: RefCell<BTreeMap<(Measure, String, String), Option<Estimate>>>,
}

impl<'r> Estimates<'r> {
    pub(super) fn new(results: &'r Results) -> Self {
        Self { results, cache: RefCell::default() }
    }
}

/// Context in which a statement is evaluated.
pub(super) struct Context<'e> {
    pub(super) estimates: &'e Estimates<'e>,
    pub(super) limits: Limits,
    pub(super) task: &'e str,
    /// Our method that represents the paper's.
    pub(super) subject: &'e str,
}

impl Context<'_> {
    /// Returns the label of a statement's method in the results.
    pub(super) fn label<'n>(&'n self, method: &'n str) -> &'n str {
        if method == PROPOSED { self.subject } else { method }
    }

    pub(super) fn runs<'r>(&'r self, method: &'r str) -> Vec<&'r Run> {
        self.estimates.results.of(self.task, self.label(method)).collect()
    }

    /// Returns the measure that defines whether the task is learnt.
    pub(super) fn learning_measure(&self) -> Measure {
        threshold(self.task).map_or(Measure::Return, |threshold| threshold.measure)
    }

    /// Returns the verdict if a method does not have enough data; otherwise `None`.
    ///
    /// - `count`: number of known scores of the method.
    pub(super) fn missing_data(&self, method: &str, count: usize) -> Option<Verdict> {
        let is_short = |run: &&Run| run.final_episodes.is_none_or(|count| count < EPISODES_MIN);
        match count {
            0 => Some(Verdict::NotRun),
            _ if count < SEEDS_MIN => Some(Verdict::TooFewSeeds),
            _ if self.runs(method).iter().any(is_short) => Some(Verdict::TooFewEpisodes),
            _ => None,
        }
    }

    /// Estimates a measure of a method; `None` if there are no scores, or if the measure is the
    /// steps to a threshold and some runs have none.
    pub(super) fn estimate(&self, measure: Measure, method: &str) -> Option<Estimate> {
        let key = (measure, self.task.to_owned(), self.label(method).to_owned());
        if let Some(cached) = self.estimates.cache.borrow().get(&key) {
            return *cached;
        }
        let runs = self.runs(method);
        let scores: Vec<f64> = runs.iter().filter_map(|run| measure.of(run)).collect();
        let estimate = if measure == Measure::StepsToThreshold {
            // Runs without a score are unfinished and will need more steps. Without them the
            // estimate would be too low.
            (!scores.is_empty() && scores.len() == runs.len()).then(|| {
                let (point, [low, high]) = median_with_bounds(&scores);
                Estimate { count: scores.len(), point, low, high }
            })
        } else {
            Estimate::of(&scores)
        };
        self.estimates.cache.borrow_mut().insert(key, estimate);
        estimate
    }

    /// Formats a method's estimate, such as `TD3 -7.89 [-8.40, -7.31], 5 seeds`.
    pub(super) fn figure(&self, measure: Measure, method: &str) -> String {
        let label = self.label(method);
        let runs = self.runs(method);
        let measured = runs.iter().copied().filter(|run| measure.of(run).is_some());
        let mark = SoftwareCounts::of(measured).mark();
        match self.estimate(measure, method) {
            None if runs.is_empty() => format!("{label}: not run"),
            // Of a finished run, only measures of motion can be unknown.
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
