//! What `dmprl doctor` looks at: one check each, with what was found and what to do about it.
//!
//! `machine` asks the system, `room` compares its limits with what a run takes, `python` looks at
//! the interpreter and `.venv`. Nothing here changes anything.

mod machine;
#[cfg(feature = "python")]
mod python;
mod room;

use dmprl_shared::config::{ExperimentConfig, TaskDefaults};
use serde::Serialize;

/// How it stands with one thing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Status {
    Ok,
    /// Runs work; something is worth knowing.
    Warning,
    /// Runs do not work.
    Problem,
}

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Check {
    name: &'static str,
    status: Status,
    /// What is there.
    found: String,
    /// What to do; none when all is well.
    advice: Option<String>,
}

impl Check {
    fn ok(name: &'static str, found: impl Into<String>) -> Self {
        Self { name, status: Status::Ok, found: found.into(), advice: None }
    }

    fn warning(name: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { status: Status::Warning, advice: Some(advice.into()), ..Self::ok(name, found) }
    }

    fn problem(name: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { status: Status::Problem, advice: Some(advice.into()), ..Self::ok(name, found) }
    }
}

/// A task as `dmprl train TASK` runs it here.
#[derive(Debug)]
pub(crate) struct DefaultRun {
    pub(crate) task: &'static TaskDefaults,
    /// Resolved.
    pub(crate) config: ExperimentConfig,
}

/// All checks.
#[derive(Debug)]
pub(crate) struct Report(Vec<Check>);

impl Report {
    /// Looks at everything. `runs`: what has to fit.
    pub(crate) fn of_this_machine(runs: &[DefaultRun]) -> Self {
        let mut checks = machine::checks();
        #[cfg(feature = "python")]
        checks.extend(python::checks());
        #[cfg(not(feature = "python"))]
        checks.push(Check::ok("python", "not in this build, which is a learner only"));
        checks.extend(room::checks(runs));
        Self(checks)
    }

    /// How many things keep runs from working.
    pub(crate) fn problems(&self) -> usize {
        self.count(Status::Problem)
    }

    fn count(&self, status: Status) -> usize {
        self.0.iter().filter(|check| check.status == status).count()
    }

    /// The checks and their numbers.
    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "checks": self.0,
            "problems": self.problems(),
            "warnings": self.count(Status::Warning),
        })
    }

    /// A line for each check, its advice below.
    pub(crate) fn text(&self) -> String {
        let mut lines = Vec::new();
        for Check { name, status, found, advice } in &self.0 {
            let status = match status {
                Status::Ok => "ok",
                Status::Warning => "warning",
                Status::Problem => "PROBLEM",
            };
            let below = |text: &str| text.replace('\n', &format!("\n{:25}", ""));
            lines.push(format!("{status:<8} {name:<15} {}", below(found)));
            lines.extend(advice.as_ref().map(|advice| format!("{:25}{}", "", below(advice))));
        }
        let (problems, warnings) = (self.problems(), self.count(Status::Warning));
        lines.push(match (problems, warnings) {
            (0, 0) => "\nnothing to do".to_owned(),
            (problems, warnings) => format!("\nproblems {problems}, warnings {warnings}"),
        });
        lines.join("\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_stands_below_what_was_found() {
        let report = Report(vec![
            Check::ok("cores", "2"),
            Check::warning("leftovers", "3", "dmprl clean"),
            Check::problem("open files", "64", "raise\nit"),
        ]);
        assert_eq!(
            report.text(),
            "ok       cores           2\n\
             warning  leftovers       3\n\
             \x20                        dmprl clean\n\
             PROBLEM  open files      64\n\
             \x20                        raise\n\
             \x20                        it\n\n\
             problems 1, warnings 1"
        );
        assert_eq!(report.json()["checks"][2]["status"], "problem");
        assert_eq!((report.problems(), report.json()["warnings"].as_u64()), (1, Some(1)));
    }
}
