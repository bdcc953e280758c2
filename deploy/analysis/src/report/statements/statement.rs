//! The paper's statements about its results, as rules. `deploy/experiments/paper-statements.toml`
//! has and explains them.

use anyhow::Context;
use serde::Deserialize;

use crate::report::measures::Measure;

/// Embedded in the binary, because the program may run without its repository.
const FILE: &str = include_str!("../../../../experiments/paper-statements.toml");

/// The paper's own method. A statement about it is evaluated with each of [`SUBJECTS`].
pub(super) const PROPOSED: &str = "DDPG-DMP of the paper";
/// Our versions of the paper's method: with the paper's values, and with the defaults.
pub const SUBJECTS: [&str; 2] = ["DDPG-DMP (paper)", "DDPG-DMP"];

/// All statements, in the paper's order.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PaperStatements {
    pub(super) limits: Limits,
    #[serde(rename = "statement")]
    pub(super) statements: Vec<Statement>,
}

impl PaperStatements {
    /// Parses the embedded file.
    ///
    /// # Errors
    /// The file is invalid, which a test rules out.
    pub(super) fn read() -> anyhow::Result<Self> {
        toml::from_str(FILE).context("cannot parse the paper's statements")
    }
}

/// Limits that quantify the paper's words.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Maximum success rate that counts as failure.
    pub failure: f64,
    /// Minimum success rate that counts as "almost 100 %".
    pub almost_always: f64,
    /// Success rate above which a method succeeds more often than not.
    pub mostly: f64,
    /// Fraction of the gain; a smaller loss counts as noise.
    pub loss: f64,
}

/// A statement of the paper.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Statement {
    /// Identifies it in the JSON output.
    pub(super) id: String,
    /// The task.
    pub(super) task: String,
    /// Section of the paper.
    pub(super) place: String,
    /// The claim, in our words.
    pub(super) claim: String,
    pub(super) rule: Rule,
}

/// Condition under which a statement holds. `method` is compared with each of `than`.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Rule {
    /// Better in each of `measures`.
    Better { measures: Vec<Measure>, method: String, than: Vec<String> },
    /// The return is higher by a margin.
    BetterBy { method: String, margins: Vec<Margin> },
    /// No two of `methods` clearly differ.
    Alike { measure: Measure, methods: Vec<String> },
    /// Reaches the threshold in less than a fraction (`share`) of the other's steps.
    Sooner {
        method: String,
        than: Vec<String>,
        #[serde(default = "whole")]
        share: f64,
        reported_steps: Option<ReportedSteps>,
    },
    /// Reaches the threshold within `steps`.
    Within { method: String, steps: u64 },
    /// None of `methods` succeeds more often than not within `steps`.
    NoneWithin { methods: Vec<String>, steps: u64 },
    /// Each of `methods` ends at a success rate of almost 100 %.
    Succeeds { methods: Vec<String> },
    /// Ends with failure, after at least `steps`.
    Fails {
        method: String,
        #[serde(default)]
        steps: u64,
    },
    /// Each of `methods` ends no better than its first evaluation.
    Unimproved { methods: Vec<String> },
    /// Each of `methods` loses more than a fraction of its gain, after at least `steps`.
    Falls {
        methods: Vec<String>,
        #[serde(default)]
        steps: u64,
    },
    /// The standard deviation that the paper reports is possible for success rates.
    Spread { method: String },
}

fn whole() -> f64 {
    1.0
}

/// Margin by which a return is higher than another method's.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Margin {
    /// The other method.
    pub(super) than: String,
    /// Margin in percent of the other method's return.
    pub(super) percent: f64,
}

/// Environment steps that the paper reports for both methods.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ReportedSteps {
    pub(super) method: f64,
    pub(super) than: f64,
}

impl Rule {
    /// Returns the labels of the methods that the rule compares, [`PROPOSED`] for the paper's own.
    pub(super) fn methods(&self) -> Vec<&str> {
        let (one, others): (Option<&String>, Vec<&String>) = match self {
            Self::Better { method, than, .. } | Self::Sooner { method, than, .. } => {
                (Some(method), than.iter().collect())
            }
            Self::BetterBy { method, margins } => {
                (Some(method), margins.iter().map(|margin| &margin.than).collect())
            }
            Self::Within { method, .. } | Self::Fails { method, .. } | Self::Spread { method } => {
                (Some(method), Vec::new())
            }
            Self::Alike { methods, .. }
            | Self::NoneWithin { methods, .. }
            | Self::Succeeds { methods }
            | Self::Unimproved { methods }
            | Self::Falls { methods, .. } => (None, methods.iter().collect()),
        };
        one.into_iter().chain(others).map(String::as_str).collect()
    }

    /// Returns true if the rule involves the paper's own method.
    pub(super) fn is_about_proposed(&self) -> bool {
        self.methods().contains(&PROPOSED)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::report::thresholds::threshold;

    #[test]
    fn every_statement_has_a_unique_id_a_section_and_the_threshold_it_needs() {
        let statements = PaperStatements::read().unwrap().statements;
        assert_eq!(statements.len(), 34);
        let ids: BTreeSet<&str> = statements.iter().map(|it| it.id.as_str()).collect();
        assert_eq!(ids.len(), statements.len(), "an id occurs twice");
        for statement in &statements {
            assert!(statement.place.starts_with("section 4."), "{}", statement.id);
            if let Rule::Sooner { .. } | Rule::Within { .. } = statement.rule {
                assert!(threshold(&statement.task).is_some(), "{}", statement.id);
            }
        }
    }

    #[test]
    fn every_method_is_a_label_in_the_papers_sweep() {
        const SWEEP: &str = include_str!("../../../../experiments/paper.toml");
        let is_known =
            |method: &str| method == PROPOSED || SWEEP.contains(&format!("label = \"{method}\""));
        for Statement { id, rule, .. } in PaperStatements::read().unwrap().statements {
            let methods = rule.methods();
            let unknown: Vec<_> = methods.iter().filter(|method| !is_known(method)).collect();
            assert!(unknown.is_empty(), "{id}: {unknown:?}");
        }
    }

    #[test]
    fn misspelt_key_is_an_error() {
        let text = FILE.replacen("than = [\"DDPG\"]", "then = [\"DDPG\"]", 1);
        assert!(toml::from_str::<PaperStatements>(&text).is_err());
    }
}
