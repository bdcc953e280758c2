//! Compares the runs with the paper's statements about its results.
//!
//! `statement` reads the statements as rules from `deploy/experiments/paper-statements.toml`.
//! `rules` and `series` apply them to the runs, with `estimates` of their measures, and
//! `contradictions` checks them against the paper's own figures. `verdict` lists the possible
//! results.

mod contradictions;
mod estimates;
mod rules;
mod series;
mod statement;
#[cfg(test)]
mod tests;
mod verdict;

use serde::Serialize;

use self::estimates::{Context, Estimates};
pub use self::statement::{Limits, SUBJECTS};
use self::statement::{PROPOSED, PaperStatements, Statement};
pub use self::verdict::{EPISODES_MIN, SEEDS_MIN, Verdict};
use super::results::Results;

/// The verdict on a statement, with evidence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Our method that represents the paper's; null if the statement is not about it.
    pub subject: Option<&'static str>,
    /// The verdict.
    pub verdict: Verdict,
    /// The verdict as text.
    pub verdict_text: &'static str,
    /// Figures of the runs, or the missing data.
    pub evidence: String,
}

/// A statement of the paper with its verdicts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClaimResult {
    /// Identifies the statement.
    pub id: String,
    /// The task.
    pub task: String,
    /// Section of the paper.
    pub place: String,
    /// The claim, in our words.
    pub claim: String,
    /// How the paper's figures contradict it; null if they do not.
    pub contradiction: Option<String>,
    /// A finding for each method that represents the paper's.
    pub findings: Vec<Finding>,
}

/// The paper's statements with their verdicts.
#[derive(Debug, Clone)]
pub struct PaperClaims {
    /// Limits used by the rules.
    pub limits: Limits,
    /// The statements whose methods have runs, in the paper's order.
    pub results: Vec<ClaimResult>,
    /// Number of statements left out, because a method has no run on their task.
    pub left_out: usize,
}

/// Evaluates the statements whose methods have runs on their task.
///
/// # Errors
/// The embedded statements cannot be parsed, which is not expected.
pub fn evaluate_statements(results: &Results) -> anyhow::Result<PaperClaims> {
    let PaperStatements { limits, statements } = PaperStatements::read()?;
    let count = statements.len();
    let estimates = Estimates::new(results);
    let labels: Vec<&'static str> =
        SUBJECTS.into_iter().filter(|label| results.methods.iter().any(|it| it == label)).collect();
    let has_runs = |task: &str, method: &str| results.of(task, method).next().is_some();
    let is_of_runs = |Statement { task, rule, .. }: &Statement| {
        rule.methods().into_iter().all(|method| match method {
            PROPOSED => labels.iter().any(|label| has_runs(task, label)),
            label => has_runs(task, label),
        })
    };
    let kept = statements.into_iter().filter(is_of_runs);
    let results: Vec<ClaimResult> =
        kept.map(|statement| evaluate(statement, &estimates, limits, &labels)).collect();
    Ok(PaperClaims { limits, left_out: count - results.len(), results })
}

/// Evaluates a statement.
///
/// - `labels`: labels of our versions of the paper's method that have runs.
fn evaluate(
    statement: Statement,
    estimates: &Estimates<'_>,
    limits: Limits,
    labels: &[&'static str],
) -> ClaimResult {
    let contradiction = contradictions::of(&statement);
    let subjects: Vec<Option<&'static str>> = if !statement.rule.is_about_proposed() {
        vec![None]
    } else {
        labels.iter().copied().map(Some).collect()
    };
    let findings = subjects.into_iter().map(|subject| {
        let task = &statement.task;
        let context = Context { estimates, limits, task, subject: subject.unwrap_or(PROPOSED) };
        let judgement = rules::judge(&context, &statement.rule);
        let verdict = if contradiction.is_some() { Verdict::CannotHold } else { judgement.verdict };
        Finding { subject, verdict, verdict_text: verdict.text(), evidence: judgement.evidence }
    });
    let findings = findings.collect();
    let Statement { id, place, claim, task, .. } = statement;
    ClaimResult { id, task, place, claim, contradiction, findings }
}

/// Counts the statements by verdict, for one of [`SUBJECTS`].
#[must_use]
pub fn counts(claims: &[ClaimResult], subject: &str) -> Vec<(Verdict, usize)> {
    let is_counted = |finding: &&Finding| finding.subject.is_none_or(|other| other == subject);
    let findings = claims.iter().flat_map(|claim| &claim.findings).filter(is_counted);
    let verdicts: Vec<Verdict> = findings.map(|finding| finding.verdict).collect();
    Verdict::ALL
        .into_iter()
        .map(|verdict| (verdict, verdicts.iter().filter(|other| **other == verdict).count()))
        .filter(|(_, count)| *count > 0)
        .collect()
}
