//! The summary at the end of a run.

use std::path::Path;
use std::time::Duration;

use dmprl_run::format::{duration, grouped, plus_minus, shown};
use dmprl_supervisor::SessionReport;

/// Formats the session's results, their directory, and suggested next commands.
#[must_use]
pub fn summary(report: &SessionReport, title: &str, run: &Path, steps_total: u64) -> String {
    let mut lines = vec![("run", title.to_owned())];
    if let Some(row) = &report.last_row {
        let count = row.returns.len();
        lines.push(("return", format!("{} over {count} episodes", plus_minus(&row.returns))));
        if let Some(rate) = row.success_rate {
            lines.push(("success", format!("{:.0} %", rate * 100.0)));
        }
    }
    if let (Some(first), Some(last)) = (&report.first, &report.last) {
        let seconds = report.training.as_secs_f64();
        let line = |now: u64, then: u64| {
            let rate = now.saturating_sub(then) as f64 / seconds;
            // A session shorter than the interval between two reports has no rate.
            let rate = if seconds > 0.0 { format!(" ({rate:.0}/s)") } else { String::new() };
            format!("{}{rate}", grouped(now))
        };
        lines.push(("steps", line(last.env_steps, first.env_steps)));
        lines.push(("updates", line(last.updates, first.updates)));
    }
    if report.env_failures > 0 {
        let logs = shown(&run.join("logs"));
        let count = grouped(report.env_failures);
        lines.push(("failures", format!("{count} in environments; see {logs}")));
    }
    if report.learner_restarts > 0 {
        lines.push(("restarts", format!("{} of the learner", report.learner_restarts)));
    }
    lines.push(("wall time", wall(report.wall)));
    let run = shown(run);
    lines.push(("results", run.clone()));
    lines.push(("next", format!("dmprl eval {run}")));
    // Without its last checkpoint the run could not be resumed from here.
    if report.checkpointed {
        lines.push(("", format!("dmprl resume {run} --steps {}", steps_total.saturating_mul(2))));
    }
    let lines = lines.iter().map(|(name, value)| format!("  {name:<10} {value}"));
    lines.collect::<Vec<_>>().join("\n")
}

fn wall(wall: Duration) -> String {
    if wall < Duration::from_secs(60) {
        format!("{:.1} s", wall.as_secs_f64())
    } else {
        duration(wall)
    }
}
