//! Applies the rules that compare final figures.

use std::iter::once;

use dmprl_run::format::grouped;

use super::estimates::{Context, Estimate};
use super::series;
use super::statement::{Margin, Rule};
use super::verdict::{Judgement, Verdict, all, clear};
use crate::report::measures::Measure;
use crate::report::paper::{PaperTable, reported};
use crate::report::run::Run;

/// Judges whether a rule holds for the runs.
pub(super) fn judge(context: &Context<'_>, rule: &Rule) -> Judgement {
    match rule {
        Rule::Better { measures, method, than } => better(context, measures, method, than),
        Rule::BetterBy { method, margins } => better_by(context, method, margins),
        Rule::Alike { measure, methods } => alike(context, *measure, methods),
        Rule::Sooner { method, than, share, .. } => sooner(context, method, than, *share),
        Rule::Within { method, steps } => series::within(context, method, *steps),
        Rule::NoneWithin { methods, steps } => series::none_within(context, methods, *steps),
        Rule::Succeeds { methods } => succeeds(context, methods),
        Rule::Fails { method, steps } => fails(context, method, *steps),
        Rule::Unimproved { methods } => series::unimproved(context, methods),
        Rule::Falls { methods, steps } => series::falls(context, methods, *steps),
        Rule::Spread { method } => as_in_paper(context, method),
    }
}

/// Compares two methods; if one of them has too little data, returns that verdict.
fn compare(
    context: &Context<'_>,
    measure: Measure,
    methods: [&str; 2],
    judge: impl Fn(Estimate, Estimate) -> Verdict,
) -> Verdict {
    let [one, other] = methods.map(|method| context.estimate(measure, method));
    let count = |estimate: Option<Estimate>| estimate.map_or(0, |estimate| estimate.count);
    let missing = [
        context.missing_data(methods[0], count(one)),
        context.missing_data(methods[1], count(other)),
    ];
    match (one, other) {
        (Some(one), Some(other)) if missing == [None, None] => judge(one, other),
        _ => all(missing.into_iter().flatten()),
    }
}

/// Judges the success rate of a method; if it has too little data, returns that verdict.
fn judge_success(
    context: &Context<'_>,
    method: &str,
    judge: impl Fn(Estimate) -> Verdict,
) -> Verdict {
    let estimate = context.estimate(Measure::Success, method);
    let missing = context.missing_data(method, estimate.map_or(0, |estimate| estimate.count));
    match (missing, estimate) {
        (Some(missing), _) => missing,
        (None, None) => Verdict::NotRun,
        (None, Some(estimate)) => judge(estimate),
    }
}

fn better(
    context: &Context<'_>,
    measures: &[Measure],
    method: &String,
    than: &[String],
) -> Judgement {
    let of_measure = |measure: Measure| {
        all(than.iter().map(|other| {
            compare(context, measure, [method, other], |ours, theirs| {
                let (above, below) = (ours.low > theirs.high, ours.high < theirs.low);
                if measure.higher_is_better() { clear(above, below) } else { clear(below, above) }
            })
        }))
    };
    let evidence = measures.iter().map(|measure| {
        let figures = context.figures(*measure, once(method).chain(than));
        match measures {
            [_] => figures,
            _ => format!("{}: {figures}", measure.title()),
        }
    });
    let evidence = evidence.collect::<Vec<_>>().join(". ");
    Judgement::new(all(measures.iter().map(|measure| of_measure(*measure))), evidence)
}

fn better_by(context: &Context<'_>, method: &String, margins: &[Margin]) -> Judgement {
    let gain = |ours: f64, theirs: f64| 100.0 * (1.0 - ours / theirs);
    let verdicts = margins.iter().map(|Margin { than, percent }| {
        compare(context, Measure::Return, [method, than], |ours, theirs| {
            if theirs.high >= 0.0 {
                // A percentage of a return around zero is meaningless.
                return Verdict::NoClearDifference;
            }
            let low = gain(ours.low, theirs.high);
            clear(low >= *percent, gain(ours.high, theirs.low) < *percent)
        })
    });
    let verdict = all(verdicts);
    let mut gains = Vec::new();
    for Margin { than, .. } in margins {
        let pair = [method, than].map(|name| context.estimate(Measure::Return, name));
        if let [Some(ours), Some(theirs)] = pair
            && theirs.point < 0.0
        {
            gains.push(format!("{:.1} % over {than}", gain(ours.point, theirs.point)));
        }
    }
    let methods = once(method).chain(margins.iter().map(|margin| &margin.than));
    let mut evidence = context.figures(Measure::Return, methods);
    if !gains.is_empty() {
        evidence.push_str(&format!(": {}", gains.join(", ")));
    }
    Judgement::new(verdict, evidence)
}

fn alike(context: &Context<'_>, measure: Measure, methods: &[String]) -> Judgement {
    let pairs = methods.iter().enumerate().flat_map(|(index, one)| {
        methods[index + 1..].iter().map(move |other| [one.as_str(), other.as_str()])
    });
    let verdicts = pairs.map(|pair| {
        compare(context, measure, pair, |a, b| clear(false, a.low > b.high || a.high < b.low))
    });
    // The statement claims that there is no clear difference.
    let verdict = match all(verdicts) {
        Verdict::NoClearDifference => Verdict::Held,
        verdict => verdict,
    };
    Judgement::new(verdict, context.figures(measure, methods))
}

fn sooner(context: &Context<'_>, method: &String, than: &[String], share: f64) -> Judgement {
    let verdicts = than.iter().map(|other| {
        compare(context, Measure::StepsToThreshold, [method, other], |ours, theirs| {
            clear(ours.high < share * theirs.low, ours.low > share * theirs.high)
        })
    });
    let evidence = context.figures(Measure::StepsToThreshold, once(method).chain(than));
    Judgement::new(all(verdicts), evidence)
}

fn succeeds(context: &Context<'_>, methods: &[String]) -> Judgement {
    let least = context.limits.almost_always;
    let verdicts = methods
        .iter()
        .map(|method| judge_success(context, method, |of| clear(of.low >= least, of.high < least)));
    Judgement::new(all(verdicts), context.figures(Measure::Success, methods))
}

fn fails(context: &Context<'_>, method: &str, steps: u64) -> Judgement {
    let most = context.limits.failure;
    let evidence = context.figure(Measure::Success, method);
    let verdict = judge_success(context, method, |of| clear(of.high <= most, of.low > most));
    let ended = context.runs(method).into_iter().filter_map(Run::last);
    let shortest = ended.map(|row| row.env_steps).min().unwrap_or(0);
    if verdict != Verdict::DidNotHold && shortest > 0 && shortest < steps {
        let text = format!("{evidence}, but the runs end at {} steps", grouped(shortest));
        return Judgement::new(Verdict::NotRun, text);
    }
    Judgement::new(verdict, evidence)
}

fn as_in_paper(context: &Context<'_>, method: &str) -> Judgement {
    let evidence = context.figure(Measure::Success, method);
    let Some((mean, _)) = reported(PaperTable::Success, context.task, context.label(method)) else {
        return Judgement::new(Verdict::NotRun, evidence);
    };
    let verdict = judge_success(context, method, |of| {
        let is_within = (of.low..=of.high).contains(&mean);
        clear(is_within, !is_within)
    });
    Judgement::new(verdict, evidence)
}
