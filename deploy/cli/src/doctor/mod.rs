//! Checks of `dmprl doctor`. Each has a finding and, if something is wrong, a remedy.
//!
//! `machine` checks platform, memory, disk and GPU, `room` compares the kernel's limits with the
//! needs of a run, and `python` checks the interpreter and `.venv`. No check changes anything.

mod machine;
#[cfg(feature = "python")]
mod python;
mod room;

use dmprl_shared::config::{ExperimentConfig, TaskDefaults};
use serde::Serialize;

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Status {
    Ok,
    /// Runs work, perhaps slowly or with restrictions.
    Warning,
    /// Runs do not work.
    Problem,
}

/// A check and its result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Check {
    name: &'static str,
    status: Status,
    found: String,
    /// Remedy; `None` if nothing is wrong.
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

/// A task with the configuration of `dmprl train TASK` on this machine.
#[derive(Debug)]
pub(crate) struct DefaultRun {
    pub(crate) task: &'static TaskDefaults,
    pub(crate) config: ExperimentConfig,
}

/// The results of all checks.
#[derive(Debug)]
pub(crate) struct Report(Vec<Check>);

impl Report {
    /// Runs all checks. Every one of `runs` has to fit the machine's limits.
    pub(crate) fn of_this_machine(runs: &[DefaultRun]) -> Self {
        let mut checks = machine::checks();
        #[cfg(feature = "python")]
        checks.extend(python::checks());
        #[cfg(not(feature = "python"))]
        checks.push(Check::ok("python", "not in this build, which has only the learner"));
        checks.extend(room::checks(runs));
        Self(checks)
    }

    /// Returns the number of problems, which prevent runs from working.
    pub(crate) fn problems(&self) -> usize {
        self.count(Status::Problem)
    }

    fn count(&self, status: Status) -> usize {
        self.0.iter().filter(|check| check.status == status).count()
    }

    /// Returns the checks and the numbers of problems and warnings.
    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "checks": self.0,
            "problems": self.problems(),
            "warnings": self.count(Status::Warning),
        })
    }

    /// Formats a line for each check, with its advice below.
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
            (0, 0) => "\nno problems".to_owned(),
            (problems, warnings) => format!("\nproblems {problems}, warnings {warnings}"),
        });
        lines.join("\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_is_printed_below_the_finding() {
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
