//! Rules about the course of a run's evaluations, rather than about one figure of it.

use super::Verdict;
use super::list::Methods;
use super::rules::{Estimate, Judgement, On, all, clear};
use crate::report::measures::Measure;
use crate::report::run::Run;
use crate::terminal::grouped;

/// Evaluations in a moving mean: a best of many single ones would be luck.
const WINDOW: usize = 5;

/// `26,000`, or that it was never there.
pub(super) fn steps_text(steps: f64) -> String {
    if steps.is_finite() { grouped(steps.round() as u64) } else { "not reached".to_owned() }
}

fn steps_of(run: &Run) -> u64 {
    run.rows.last().map_or(0, |row| row.env_steps)
}

/// `method` is at the threshold within `steps`.
pub(super) fn within(on: &On<'_>, method: &str, steps: u64) -> Judgement {
    let runs = on.runs(method);
    let there = |run: &Run| {
        let reached = Measure::StepsToThreshold.of(run).unwrap_or(f64::INFINITY);
        if reached <= steps as f64 {
            Some(true)
        } else {
            // One that has not come so far may still be in time.
            (steps_of(run) >= steps).then_some(false)
        }
    };
    let known: Vec<bool> = runs.iter().filter_map(|run| there(run)).collect();
    let reached = known.iter().filter(|there| **there).count();
    let evidence = match (known.len(), runs.len()) {
        (_, 0) => format!("{}: not run", on.name(method)),
        (0, _) => format!("{}: not finished", on.name(method)),
        (count, _) => format!("{}: {reached} of {count} seeds", on.name(method)),
    };
    let verdict = on
        .lacking(method, known.len())
        .unwrap_or_else(|| clear(reached == known.len(), reached == 0));
    (verdict, evidence)
}

/// None of `methods` succeeds in more than a share of the episodes within so many steps.
pub(super) fn none_within(on: &On<'_>, methods: Methods, limits: (f64, u64)) -> Judgement {
    let (verdicts, texts): (Vec<_>, Vec<_>) =
        methods.iter().map(|method| not_within(on, method, limits)).unzip();
    (all(verdicts), texts.join("; "))
}

fn not_within(on: &On<'_>, method: &str, (success, steps): (f64, u64)) -> Judgement {
    let runs = on.runs(method);
    let highest = |run: &Run| {
        let rows = run.rows.iter().filter(|row| row.env_steps <= steps);
        rows.filter_map(|row| row.success_rate).fold(0.0, f64::max)
    };
    let name = on.name(method);
    if runs.is_empty() {
        return (Verdict::NotRun, format!("{name}: not run"));
    }
    let best: Vec<f64> = runs.iter().map(|run| highest(run)).collect();
    let passed = best.iter().filter(|best| **best > success).count();
    let shortest = runs.iter().map(|run| steps_of(run)).min().unwrap_or(0);
    let best = best.iter().copied().fold(0.0, f64::max);
    let text = format!(
        "{name}: at most {best:.2} within {} steps, {} seeds",
        grouped(shortest.min(steps)),
        runs.len()
    );
    let verdict = match on.lacking(method, runs.len()) {
        Some(lacking) => lacking,
        None if passed == runs.len() => Verdict::DidNotHold,
        // What is still to come may decide.
        None if shortest < steps => Verdict::NotRun,
        None => clear(passed == 0, false),
    };
    (verdict, text)
}

/// The last evaluation of each of `methods` is not clearly better than its first.
pub(super) fn unimproved(on: &On<'_>, methods: Methods) -> Judgement {
    let measure = on.measure();
    let gain = |run: &Run| {
        let [first, last] = [run.rows.first()?, run.last()?].map(|row| measure.of_row(row));
        Some(last? - first?)
    };
    let judged = methods.iter().map(|method| {
        over_seeds(on, method, gain, |estimate| {
            let text = format!("last less first evaluation {}", estimate.text(measure.digits()));
            (clear(estimate.low <= 0.0, estimate.low > 0.0), text)
        })
    });
    let (verdicts, texts): (Vec<_>, Vec<_>) = judged.unzip();
    (all(verdicts), texts.join("; "))
}

/// Each of `methods` ends below its best by more than a share of what it had won.
pub(super) fn falls(on: &On<'_>, methods: Methods, (share, steps): (f64, u64)) -> Judgement {
    let measure = on.measure();
    let loss = |run: &Run| {
        if !run.ended || steps_of(run) < steps {
            return None;
        }
        let values: Option<Vec<f64>> = run.rows.iter().map(|row| measure.of_row(row)).collect();
        lost_share(&values?)
    };
    let judged = methods.iter().map(|method| {
        over_seeds(on, method, loss, |estimate| {
            let text = format!("share lost of what was won {}", estimate.text(2));
            (clear(estimate.low > share, estimate.high < share), text)
        })
    });
    let (verdicts, texts): (Vec<_>, Vec<_>) = judged.unzip();
    (all(verdicts), texts.join("; "))
}

/// Of what moving means had won over the first evaluation; none where there are too few, or
/// nothing was won.
fn lost_share(values: &[f64]) -> Option<f64> {
    let first = *values.first()?;
    let means: Vec<f64> =
        values.windows(WINDOW).map(|window| window.iter().sum::<f64>() / WINDOW as f64).collect();
    let peak = means.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let won = peak - first;
    (won > 0.0).then(|| Some((peak - means.last()?) / won)).flatten()
}

/// Judges a figure that each run has at its end.
fn over_seeds(
    on: &On<'_>,
    method: &str,
    score: impl Fn(&Run) -> Option<f64>,
    judge: impl Fn(Estimate) -> Judgement,
) -> Judgement {
    let runs = on.runs(method);
    let scores: Vec<f64> = runs.iter().filter_map(|run| score(run)).collect();
    let name = on.name(method);
    let Some(estimate) = Estimate::of(&scores) else {
        let longest = runs.iter().map(|run| steps_of(run)).max();
        let state = longest.map_or_else(
            || "not run".to_owned(),
            |steps| format!("nothing to judge by in {} steps", grouped(steps)),
        );
        return (Verdict::NotRun, format!("{name}: {state}"));
    };
    let (verdict, text) = judge(estimate);
    (on.lacking(method, scores.len()).unwrap_or(verdict), format!("{name}: {text}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_lost_is_a_share_of_what_was_won() {
        let share = |values: &[f64]| lost_share(values);
        assert_eq!(share(&[0.0, 10.0, 10.0, 10.0, 10.0, 10.0]), Some(0.0));
        let falls = [0.0, 10.0, 10.0, 10.0, 10.0, 10.0, 5.0, 5.0, 5.0, 5.0, 5.0];
        assert_eq!(share(&falls), Some(0.5));
        assert_eq!(share(&[0.0; 3]), None, "fewer than a mean takes");
        assert_eq!(share(&[0.0; 9]), None, "nothing was won");
    }
}
