//! Finds the statements that contradict the paper's own figures.

use super::statement::{Margin, PROPOSED, ReportedSteps, Rule, Statement};
use crate::report::measures::Measure;
use crate::report::paper::{PaperTable, SEEDS, reported};

/// Tolerance for the paper's percentages, which have one decimal and come from rounded figures.
const ROUNDING_PERCENT: f64 = 0.15;
/// Label of the paper's method in [`reported`].
const TABLE_LABEL: &str = "DDPG-DMP (paper)";

/// Describes how the paper's figures contradict the statement; `None` if they do not.
pub(super) fn of(statement: &Statement) -> Option<String> {
    let task = statement.task.as_str();
    match &statement.rule {
        Rule::Better { measures, method, than } => {
            measures.iter().find_map(|measure| surpassed(task, *measure, method, than))
        }
        Rule::BetterBy { method, margins } => {
            let wrong = margins.iter().filter_map(|Margin { than, percent }| {
                let [ours, theirs] =
                    [method, than].map(|name| reported_mean(PaperTable::Return, task, name));
                let real = 100.0 * (ours? - theirs?) / theirs?.abs();
                let differs = (real - percent).abs() > ROUNDING_PERCENT;
                differs.then(|| format!("{real:.1} % over {than}, not {percent:.1} %"))
            });
            let wrong: Vec<_> = wrong.collect();
            (!wrong.is_empty()).then(|| format!("by its Table 3 it is {}", wrong.join(" and ")))
        }
        Rule::Sooner { share, reported_steps: Some(ReportedSteps { method, than }), .. } => {
            let (said, real) = (100.0 * (1.0 - share), 100.0 * (1.0 - method / than));
            let differs = (real - said).abs() > ROUNDING_PERCENT;
            differs.then(|| format!("of these steps it is {real:.1} % fewer, not {said:.1} %"))
        }
        Rule::Spread { method } => {
            let (mean, std) = reported(PaperTable::Success, task, table_label(method))?;
            let max = std_max(mean, SEEDS);
            (std > max).then(|| {
                format!(
                    "{SEEDS} rates between 0 and 1 with the mean {mean:.2} have a standard \
                     deviation of at most {max:.2}"
                )
            })
        }
        _ => None,
    }
}

/// Describes the methods that have higher figures in the paper's table than the allegedly best one.
fn surpassed(task: &str, measure: Measure, method: &str, than: &[String]) -> Option<String> {
    let of = measure.in_paper()?;
    let ours = reported_mean(of, task, method)?;
    let above = than.iter().filter_map(|other| {
        let theirs = reported_mean(of, task, other)?;
        (theirs > ours).then(|| format!("{other} at {theirs:.2}"))
    });
    let above: Vec<_> = above.collect();
    let table = if of == PaperTable::Return { 3 } else { 4 };
    (!above.is_empty())
        .then(|| format!("its Table {table} has {} above {ours:.2}", above.join(" and ")))
}

/// Returns the mean in a table of the paper.
fn reported_mean(table: PaperTable, task: &str, method: &str) -> Option<f64> {
    reported(table, task, table_label(method)).map(|(mean, _)| mean)
}

fn table_label(method: &str) -> &str {
    if method == PROPOSED { TABLE_LABEL } else { method }
}

/// Returns the maximum standard deviation of rates with this mean, which they have if each is 0 or
/// 1.
fn std_max(mean: f64, count: usize) -> f64 {
    let count = count as f64;
    (mean * (1.0 - mean) * count / (count - 1.0)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::statement::PaperStatements;
    use super::*;

    #[test]
    fn exactly_the_known_contradictions_are_found() {
        let found: Vec<String> = PaperStatements::read()
            .unwrap()
            .statements
            .iter()
            .filter_map(|statement| Some(format!("{}: {}", statement.task, of(statement)?)))
            .collect();
        let expected = [
            "reacher-v1: its Table 3 has DDPG at -6.58 and SAC at -6.10 above -7.36",
            "reacher-v1: of these steps it is 21.2 % fewer, not 11.7 %",
            "pusher-v0: its Table 3 has TD3 at -32.06 and SAC at -31.87 above -33.37",
            "pusher-v0: by its Table 3 it is 24.6 % over DDPG, not 43.7 % and 28.7 % over NDP, \
             not 26.7 %",
            "panda-reach-joints: 5 rates between 0 and 1 with the mean 0.85 have a standard \
             deviation of at most 0.40",
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn maximum_standard_deviation_belongs_to_rates_of_zero_and_one() {
        assert!((std_max(0.5, 2) - 0.5_f64.sqrt()).abs() < 1e-12);
        assert_eq!(std_max(1.0, 5), 0.0);
    }
}
