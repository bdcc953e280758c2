//! Applies the rules of `list` to the runs.

use std::cell::RefCell;
use std::collections::BTreeMap;

use super::list::{Methods, Rule, Statement};
use super::{EPISODES_MIN, PROPOSED, SEEDS_MIN, Verdict, series};
use crate::report::measures::Measure;
use crate::report::paper::{Figure, reported};
use crate::report::provenance::SoftwareCounts;
use crate::report::results::Results;
use crate::report::run::Run;
use crate::report::statistics::{INTERVAL_SCORES_MIN, Summary, median_with_bounds};
use crate::report::thresholds::threshold;
use crate::terminal::grouped;

/// A verdict and the figures behind it.
pub(super) type Judgement = (Verdict, String);

/// What the seeds of a method say together.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    pub(super) count: usize,
    pub(super) point: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Estimate {
    /// Interquartile mean and its interval, or mean and range below four seeds; none of nothing.
    pub(super) fn of(scores: &[f64]) -> Option<Self> {
        let summary = Summary::of(scores)?;
        let (point, [low, high]) = summary.point_and_bounds();
        Some(Self { count: summary.count, point, low, high })
    }

    pub(super) fn text(&self, digits: usize) -> String {
        let Self { count, point, low, high } = self;
        let range = self.range();
        format!("{point:.digits$} {range}[{low:.digits$}, {high:.digits$}], {count} seeds")
    }

    /// The word before the bounds where they are the range of the seeds and no interval.
    fn range(&self) -> &'static str {
        if self.count < INTERVAL_SCORES_MIN { "range " } else { "" }
    }
}

/// The verdict over several conditions that must all be met.
pub(super) fn all(verdicts: impl IntoIterator<Item = Verdict>) -> Verdict {
    let verdicts: Vec<Verdict> = verdicts.into_iter().collect();
    // One that fails decides; else what is lacking does.
    let order = [
        Verdict::DidNotHold,
        Verdict::NotRun,
        Verdict::TooFewSeeds,
        Verdict::TooFewEpisodes,
        Verdict::NoClearDifference,
        Verdict::Held,
    ];
    order.into_iter().find(|verdict| verdicts.contains(verdict)).unwrap_or(Verdict::NotRun)
}

/// Held, or not, where the figures are clearly one or the other.
pub(super) fn clear(yes: bool, no: bool) -> Verdict {
    match (yes, no) {
        (true, _) => Verdict::Held,
        (false, true) => Verdict::DidNotHold,
        (false, false) => Verdict::NoClearDifference,
    }
}

/// The runs' figures, each summarised once.
pub(super) struct Judge<'r> {
    results: &'r Results,
    known: RefCell<BTreeMap<(Measure, String, String), Option<Estimate>>>,
}

impl<'r> Judge<'r> {
    pub(super) fn of(results: &'r Results) -> Self {
        Self { results, known: RefCell::default() }
    }

    /// - `subject`: the method that stands for the paper's.
    pub(super) fn verdict(&self, statement: &Statement, subject: Option<&str>) -> Judgement {
        let on = On { judge: self, task: statement.task, subject: subject.unwrap_or(PROPOSED) };
        match statement.rule {
            Rule::Better { measures, method, than } => on.better(measures, method, than),
            Rule::BetterBy { method, than } => on.better_by(method, than),
            Rule::Alike { measure, methods } => on.alike(measure, methods),
            Rule::Sooner { method, than, share, .. } => on.sooner(method, than, share),
            Rule::Within { method, steps } => series::within(&on, method, steps),
            Rule::NoneWithin { methods, success, steps } => {
                series::none_within(&on, methods, (success, steps))
            }
            Rule::Succeeds { methods, success } => on.succeeds(methods, success),
            Rule::Fails { method, success, steps } => on.fails(method, success, steps),
            Rule::Unimproved { methods } => series::unimproved(&on, methods),
            Rule::Falls { methods, share, steps } => series::falls(&on, methods, (share, steps)),
            Rule::Spread { method } => on.as_in_paper(method),
        }
    }
}

/// A statement's task and subject.
pub(super) struct On<'j> {
    judge: &'j Judge<'j>,
    pub(super) task: &'static str,
    subject: &'j str,
}

impl On<'_> {
    /// The method's name in the results.
    pub(super) fn name<'n>(&'n self, method: &'n str) -> &'n str {
        if method == PROPOSED { self.subject } else { method }
    }

    pub(super) fn runs<'r>(&'r self, method: &'r str) -> Vec<&'r Run> {
        self.judge.results.of(self.task, self.name(method)).collect()
    }

    /// The measure by which the task is learnt.
    pub(super) fn measure(&self) -> Measure {
        threshold(self.task).map_or(Measure::Return, |threshold| threshold.measure)
    }

    /// What a method with `count` scores lacks to be judged.
    pub(super) fn lacking(&self, method: &str, count: usize) -> Option<Verdict> {
        let is_short = |run: &&Run| run.final_episodes.is_none_or(|count| count < EPISODES_MIN);
        match count {
            0 => Some(Verdict::NotRun),
            _ if count < SEEDS_MIN => Some(Verdict::TooFewSeeds),
            _ if self.runs(method).iter().any(is_short) => Some(Verdict::TooFewEpisodes),
            _ => None,
        }
    }

    fn estimate(&self, measure: Measure, method: &str) -> Option<Estimate> {
        let name = self.name(method);
        let key = (measure, self.task.to_owned(), name.to_owned());
        if let Some(known) = self.judge.known.borrow().get(&key) {
            return *known;
        }
        let runs = self.runs(method);
        let scores: Vec<f64> = runs.iter().filter_map(|run| measure.of(run)).collect();
        let estimate = if measure == Measure::StepsToThreshold {
            // Those under way would come later than those that are there: all or none.
            (!scores.is_empty() && scores.len() == runs.len()).then(|| {
                let (point, [low, high]) = median_with_bounds(&scores);
                Estimate { count: scores.len(), point, low, high }
            })
        } else {
            Estimate::of(&scores)
        };
        self.judge.known.borrow_mut().insert(key, estimate);
        estimate
    }

    /// `TD3 -7.89 [-8.40, -7.31], 3 seeds`.
    fn figure(&self, measure: Measure, method: &str) -> String {
        let name = self.name(method);
        let measured = self.runs(method).into_iter().filter(|run| measure.of(run).is_some());
        let mark = SoftwareCounts::of(measured).mark();
        match self.estimate(measure, method) {
            None if self.runs(method).is_empty() => format!("{name}: not run"),
            // Only motion can be unknown of a run at its end.
            None if self.runs(method).iter().any(|run| run.ended) && measure.is_of_motion() => {
                format!("{name}: not measured")
            }
            None => format!("{name}: not finished"),
            Some(Estimate { low: f64::INFINITY, count, .. }) => {
                format!("{name} not reached, {count} seeds{mark}")
            }
            Some(estimate) if measure == Measure::StepsToThreshold => {
                let [point, low, high] =
                    [estimate.point, estimate.low, estimate.high].map(series::steps_text);
                let range = estimate.range();
                let count = estimate.count;
                format!("{name} {point} {range}[{low} – {high}] steps, {count} seeds{mark}")
            }
            Some(estimate) => format!("{name} {}{mark}", estimate.text(measure.digits())),
        }
    }

    fn figures(&self, measure: Measure, methods: &[&str]) -> String {
        let figures = methods.iter().map(|method| self.figure(measure, method));
        figures.collect::<Vec<_>>().join("; ")
    }

    /// Compares two methods if both have enough seeds.
    fn pair(
        &self,
        measure: Measure,
        [one, other]: [&str; 2],
        judge: impl Fn(Estimate, Estimate) -> Verdict,
    ) -> Verdict {
        let [a, b] = [one, other].map(|method| self.estimate(measure, method));
        let count = |estimate: Option<Estimate>| estimate.map_or(0, |estimate| estimate.count);
        let lacking = [self.lacking(one, count(a)), self.lacking(other, count(b))];
        match (a, b) {
            (Some(a), Some(b)) if lacking == [None, None] => judge(a, b),
            _ => all(lacking.into_iter().flatten()),
        }
    }

    fn better(&self, measures: &[Measure], method: &str, than: Methods) -> Judgement {
        let methods: Vec<&str> = std::iter::once(method).chain(than.iter().copied()).collect();
        let of_measure = |measure: Measure| {
            all(than.iter().map(|other| {
                self.pair(measure, [method, other], |ours, theirs| {
                    let (above, below) = (ours.low > theirs.high, ours.high < theirs.low);
                    if measure.higher_is_better() {
                        clear(above, below)
                    } else {
                        clear(below, above)
                    }
                })
            }))
        };
        let evidence = measures.iter().map(|measure| match measures {
            [_] => self.figures(*measure, &methods),
            _ => format!("{}: {}", measure.title(), self.figures(*measure, &methods)),
        });
        let evidence = evidence.collect::<Vec<_>>().join(". ");
        (all(measures.iter().map(|measure| of_measure(*measure))), evidence)
    }

    fn better_by(&self, method: &str, than: &[(&str, f64)]) -> Judgement {
        let mut gains = Vec::new();
        let verdicts: Vec<Verdict> = than
            .iter()
            .map(|(other, percent)| {
                self.pair(Measure::Return, [method, other], |ours, theirs| {
                    if theirs.high >= 0.0 {
                        // Of a return around zero there is no share.
                        return Verdict::NoClearDifference;
                    }
                    let gain = |ours: f64, theirs: f64| 100.0 * (1.0 - ours / theirs);
                    let low = gain(ours.low, theirs.high);
                    clear(low >= *percent, gain(ours.high, theirs.low) < *percent)
                })
            })
            .collect();
        for (other, _) in than {
            let pair = [method, other].map(|name| self.estimate(Measure::Return, name));
            if let [Some(ours), Some(theirs)] = pair
                && theirs.point < 0.0
            {
                let gain = 100.0 * (1.0 - ours.point / theirs.point);
                gains.push(format!("{gain:.1} % over {other}"));
            }
        }
        let methods: Vec<&str> =
            std::iter::once(method).chain(than.iter().map(|(other, _)| *other)).collect();
        let mut evidence = self.figures(Measure::Return, &methods);
        if !gains.is_empty() {
            evidence.push_str(&format!(": {}", gains.join(", ")));
        }
        (all(verdicts), evidence)
    }

    fn alike(&self, measure: Measure, methods: Methods) -> Judgement {
        let pairs = methods
            .iter()
            .enumerate()
            .flat_map(|(index, one)| methods[index + 1..].iter().map(move |other| [*one, *other]));
        let verdicts = pairs.map(|pair| {
            self.pair(measure, pair, |a, b| clear(false, a.low > b.high || a.high < b.low))
        });
        // Where nothing clearly differs, that is what the statement says.
        let verdict = match all(verdicts) {
            Verdict::NoClearDifference => Verdict::Held,
            verdict => verdict,
        };
        (verdict, self.figures(measure, methods))
    }

    fn sooner(&self, method: &str, than: Methods, share: f64) -> Judgement {
        let verdicts = than.iter().map(|other| {
            self.pair(Measure::StepsToThreshold, [method, other], |ours, theirs| {
                clear(ours.high < share * theirs.low, ours.low > share * theirs.high)
            })
        });
        let methods: Vec<&str> = std::iter::once(method).chain(than.iter().copied()).collect();
        (all(verdicts), self.figures(Measure::StepsToThreshold, &methods))
    }

    fn succeeds(&self, methods: Methods, success: f64) -> Judgement {
        let verdicts = methods
            .iter()
            .map(|method| self.alone(method, |of| clear(of.low >= success, of.high < success)));
        (all(verdicts), self.figures(Measure::Success, methods))
    }

    fn fails(&self, method: &str, success: f64, steps: u64) -> Judgement {
        let evidence = self.figures(Measure::Success, &[method]);
        let verdict = self.alone(method, |of| clear(of.high <= success, of.low > success));
        let ended = self.runs(method).into_iter().filter_map(Run::last);
        let shortest = ended.map(|row| row.env_steps).min().unwrap_or(0);
        if verdict != Verdict::DidNotHold && shortest > 0 && shortest < steps {
            let text = format!("{evidence}, but the runs end at {} steps", grouped(shortest));
            return (Verdict::NotRun, text);
        }
        (verdict, evidence)
    }

    fn as_in_paper(&self, method: &str) -> Judgement {
        let evidence = self.figures(Measure::Success, &[method]);
        let Some((mean, _)) = reported(Figure::Success, self.task, self.name(method)) else {
            return (Verdict::NotRun, evidence);
        };
        let verdict = self.alone(method, |of| {
            let within = (of.low..=of.high).contains(&mean);
            clear(within, !within)
        });
        (verdict, evidence)
    }

    fn alone(&self, method: &str, judge: impl Fn(Estimate) -> Verdict) -> Verdict {
        let estimate = self.estimate(Measure::Success, method);
        let lacking = self.lacking(method, estimate.map_or(0, |estimate| estimate.count));
        match (lacking, estimate) {
            (Some(lacking), _) => lacking,
            (None, None) => Verdict::NotRun,
            (None, Some(estimate)) => judge(estimate),
        }
    }
}
