//! What of the paper's statements held. A verdict is never typed in: `list` has the statements as
//! rules, `rules` applies them to the runs' figures, `contradictions` to the paper's own.

mod contradictions;
mod list;
mod rules;
mod series;
#[cfg(test)]
mod tests;

use serde::Serialize;

pub use self::list::{ALMOST_ALL, LOSS, NONE};
use self::list::{STATEMENTS, Statement};
use self::rules::Judge;
use super::results::Results;

/// What the paper calls its method; two of ours are held to what it says of it.
const PROPOSED: &str = "DDPG-DMP of the paper";
/// The paper's method with the paper's values, and with ours.
pub const SUBJECTS: [&str; 2] = ["DDPG-DMP (paper)", "DDPG-DMP"];
/// Fewest seeds of a method that a statement is judged by.
pub const SEEDS_MIN: usize = 5;
/// Fewest episodes of a run's last evaluation that a statement is judged by.
pub const EPISODES_MIN: u64 = 100;

/// What became of a statement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The figures say the same, beyond their intervals.
    Held,
    /// They say the opposite, beyond their intervals.
    DidNotHold,
    /// A difference within the intervals.
    NoClearDifference,
    /// There are runs, but fewer than `SEEDS_MIN` of a method.
    TooFewSeeds,
    /// There are seeds enough, but a last evaluation has fewer than `EPISODES_MIN` episodes.
    TooFewEpisodes,
    /// Nothing to judge by.
    NotRun,
    /// The paper contradicts itself.
    CannotHold,
}

impl Verdict {
    /// For people.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            Self::Held => "held",
            Self::DidNotHold => "did not hold",
            Self::NoClearDifference => "no clear difference",
            Self::TooFewSeeds => "too few seeds",
            Self::TooFewEpisodes => "too few episodes",
            Self::NotRun => "not run",
            Self::CannotHold => "cannot hold",
        }
    }

    /// All, in the order in which they are counted.
    pub const ALL: [Self; 7] = [
        Self::Held,
        Self::DidNotHold,
        Self::NoClearDifference,
        Self::TooFewSeeds,
        Self::TooFewEpisodes,
        Self::NotRun,
        Self::CannotHold,
    ];
}

/// A verdict and the figures behind it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Of our methods, the one that stands for the paper's; none where the statement is not of it.
    pub subject: Option<&'static str>,
    /// What became of it.
    pub verdict: Verdict,
    /// The same for people.
    pub verdict_text: &'static str,
    /// What the runs show, or lack.
    pub evidence: String,
}

/// A statement of the paper and what became of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClaimResult {
    /// Of which task.
    pub task: &'static str,
    /// Where it stands.
    pub place: &'static str,
    /// What it says, in our words.
    pub claim: &'static str,
    /// How the paper contradicts itself.
    pub contradiction: Option<String>,
    /// One a method that stands for the paper's.
    pub findings: Vec<Finding>,
}

/// Every statement, if the runs are of any task of the paper.
#[must_use]
pub fn evaluate_statements(results: &Results) -> Vec<ClaimResult> {
    if !STATEMENTS.iter().any(|statement| results.tasks.iter().any(|task| task == statement.task)) {
        return Vec::new();
    }
    let judge = Judge::of(results);
    STATEMENTS.iter().map(|statement| evaluate(&judge, results, statement)).collect()
}

fn evaluate(judge: &Judge<'_>, results: &Results, statement: &Statement) -> ClaimResult {
    let contradiction = contradictions::of(statement);
    let named = |subject: &&&str| results.methods.iter().any(|method| method == **subject);
    let mut subjects: Vec<Option<&'static str>> =
        SUBJECTS.iter().filter(named).map(|subject| Some(*subject)).collect();
    if !statement.rule.is_of_proposed() {
        subjects = vec![None];
    } else if subjects.is_empty() {
        subjects.push(Some(SUBJECTS[0]));
    }
    let findings = subjects.into_iter().map(|subject| {
        let (verdict, evidence) = judge.verdict(statement, subject);
        let verdict = if contradiction.is_some() { Verdict::CannotHold } else { verdict };
        Finding { subject, verdict, verdict_text: verdict.text(), evidence }
    });
    let findings = findings.collect();
    let Statement { place, claim, task, .. } = *statement;
    ClaimResult { task, place, claim, contradiction, findings }
}

/// How many statements have each verdict, for one of [`SUBJECTS`].
#[must_use]
pub fn counts(claims: &[ClaimResult], subject: &str) -> Vec<(Verdict, usize)> {
    let of = |finding: &&Finding| finding.subject.is_none_or(|other| other == subject);
    let verdicts: Vec<Verdict> =
        claims.iter().flat_map(|claim| &claim.findings).filter(of).map(|it| it.verdict).collect();
    Verdict::ALL
        .into_iter()
        .map(|verdict| (verdict, verdicts.iter().filter(|other| **other == verdict).count()))
        .filter(|(_, count)| *count > 0)
        .collect()
}
