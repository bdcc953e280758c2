//! Applies the rules about the course of training, which use all evaluations of a run.

use dmprl_run::format::grouped;

use super::estimates::{Context, Estimate};
use super::verdict::{Judgement, Verdict, clear};
use crate::report::measures::Measure;
use crate::report::run::Run;

/// Number of evaluations in a moving mean. The maximum over single evaluations would be biased by
/// their noise.
const WINDOW: usize = 5;

fn last_step(run: &Run) -> u64 {
    run.rows.last().map_or(0, |row| row.env_steps)
}

/// Judges whether all seeds of `method` reach the threshold within `steps`.
pub(super) fn within(context: &Context<'_>, method: &str, steps: u64) -> Judgement {
    let runs = context.runs(method);
    let is_in_time = |run: &Run| {
        let reached = Measure::StepsToThreshold.of(run).unwrap_or(f64::INFINITY);
        if reached <= steps as f64 {
            Some(true)
        } else {
            // A shorter run could still have reached it in time.
            (last_step(run) >= steps).then_some(false)
        }
    };
    let known: Vec<bool> = runs.iter().filter_map(|run| is_in_time(run)).collect();
    let reached = known.iter().filter(|is_in_time| **is_in_time).count();
    let label = context.label(method);
    let evidence = match (known.len(), runs.len()) {
        (_, 0) => format!("{label}: not run"),
        (0, _) => format!("{label}: not finished"),
        (count, _) => format!("{label}: {reached} of {count} seeds"),
    };
    let verdict = context
        .missing_data(method, known.len())
        .unwrap_or_else(|| clear(reached == known.len(), reached == 0));
    Judgement::new(verdict, evidence)
}

/// Judges whether none of `methods` succeeds more often than not within `steps`.
pub(super) fn none_within(context: &Context<'_>, methods: &[String], steps: u64) -> Judgement {
    Judgement::all(methods.iter().map(|method| not_within(context, method, steps)))
}

fn not_within(context: &Context<'_>, method: &str, steps: u64) -> Judgement {
    let runs = context.runs(method);
    let highest = |run: &Run| {
        let rows = run.rows.iter().filter(|row| row.env_steps <= steps);
        rows.filter_map(|row| row.success_rate).fold(0.0, f64::max)
    };
    let label = context.label(method);
    if runs.is_empty() {
        return Judgement::new(Verdict::NotRun, format!("{label}: not run"));
    }
    let highest: Vec<f64> = runs.iter().map(|run| highest(run)).collect();
    let above = highest.iter().filter(|rate| **rate > context.limits.mostly).count();
    let shortest = runs.iter().map(|run| last_step(run)).min().unwrap_or(0);
    let highest = highest.iter().copied().fold(0.0, f64::max);
    let text = format!(
        "{label}: at most {highest:.2} within {} steps, {} seeds",
        grouped(shortest.min(steps)),
        runs.len()
    );
    let verdict = match context.missing_data(method, runs.len()) {
        Some(missing) => missing,
        None if above == runs.len() => Verdict::DidNotHold,
        // A shorter run could still have succeeded.
        None if shortest < steps => Verdict::NotRun,
        None => clear(above == 0, false),
    };
    Judgement::new(verdict, text)
}

/// Judges whether the last evaluation of each of `methods` is not clearly better than its first.
pub(super) fn unimproved(context: &Context<'_>, methods: &[String]) -> Judgement {
    let measure = context.learning_measure();
    let gain = |run: &Run| {
        let [first, last] = [run.rows.first()?, run.last()?].map(|row| measure.of_row(row));
        Some(last? - first?)
    };
    Judgement::all(methods.iter().map(|method| {
        over_seeds(context, method, gain, |estimate| {
            let text = format!("last minus first evaluation {}", estimate.text(measure.digits()));
            Judgement::new(clear(estimate.low <= 0.0, estimate.low > 0.0), text)
        })
    }))
}

/// Judges whether each of `methods` loses a fraction of its gain, after at least `steps`.
pub(super) fn falls(context: &Context<'_>, methods: &[String], steps: u64) -> Judgement {
    let measure = context.learning_measure();
    let limit = context.limits.loss;
    let loss = |run: &Run| {
        if !run.ended || last_step(run) < steps {
            return None;
        }
        let values: Option<Vec<f64>> = run.rows.iter().map(|row| measure.of_row(row)).collect();
        lost_fraction(&values?)
    };
    Judgement::all(methods.iter().map(|method| {
        over_seeds(context, method, loss, |estimate| {
            let text = format!("lost fraction of the gain {}", estimate.text(2));
            Judgement::new(clear(estimate.low > limit, estimate.high < limit), text)
        })
    }))
}

/// Returns the fraction of the gain over the first evaluation that is lost at the end, by moving
/// means; `None` without a gain or with too few evaluations.
fn lost_fraction(values: &[f64]) -> Option<f64> {
    let first = *values.first()?;
    let means: Vec<f64> =
        values.windows(WINDOW).map(|window| window.iter().sum::<f64>() / WINDOW as f64).collect();
    let peak = means.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let gain = peak - first;
    (gain > 0.0).then(|| Some((peak - means.last()?) / gain)).flatten()
}

/// Judges a score over the seeds of a method.
fn over_seeds(
    context: &Context<'_>,
    method: &str,
    score: impl Fn(&Run) -> Option<f64>,
    judge: impl Fn(Estimate) -> Judgement,
) -> Judgement {
    let runs = context.runs(method);
    let scores: Vec<f64> = runs.iter().filter_map(|run| score(run)).collect();
    let label = context.label(method);
    let Some(estimate) = Estimate::of(&scores) else {
        let longest = runs.iter().map(|run| last_step(run)).max();
        let state = longest.map_or_else(
            || "not run".to_owned(),
            |steps| format!("cannot be judged after {} steps", grouped(steps)),
        );
        return Judgement::new(Verdict::NotRun, format!("{label}: {state}"));
    };
    let Judgement { verdict, evidence } = judge(estimate);
    let verdict = context.missing_data(method, scores.len()).unwrap_or(verdict);
    Judgement::new(verdict, format!("{label}: {evidence}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loss_is_a_fraction_of_the_gain() {
        assert_eq!(lost_fraction(&[0.0, 10.0, 10.0, 10.0, 10.0, 10.0]), Some(0.0));
        let falls = [0.0, 10.0, 10.0, 10.0, 10.0, 10.0, 5.0, 5.0, 5.0, 5.0, 5.0];
        assert_eq!(lost_fraction(&falls), Some(0.5));
        assert_eq!(lost_fraction(&[0.0; 3]), None, "fewer than a moving mean needs");
        assert_eq!(lost_fraction(&[0.0; 9]), None, "there is no gain");
    }
}
