//! Formats the figures of `bench rollout` as a table.

use dmprl_run::format::grouped;

use super::figures::{Figures, NAMES, ONE_WORKER, WORKER, WorkerFigures};
use super::peers::{PANDA_GYM, is_in_panda_gym};
use super::statistics::{max, min};

impl Figures {
    /// Returns the figures as a table.
    #[must_use]
    pub fn text(&self) -> String {
        let actors = &self.config.actors;
        let rounds = self.rounds(WORKER).len();
        let mut lines = vec![
            format!(
                "{} ({}) · {} · {} × {} environments · {} steps per segment",
                self.config.task.name,
                self.env_id,
                self.policy(),
                actors.workers,
                actors.envs_per_worker,
                self.config.policy.decision_steps()
            ),
            format!("median of {rounds} rounds of {} s; step times are per worker", self.seconds),
            String::new(),
            format!(
                "  {:<10} {:>11} {:>9} {:>9}   {:<21} worker/this",
                "", "steps/s", "µs/step", "CPU µs", "from … to"
            ),
        ];
        let names = NAMES.iter().filter(|name| self.is_listed(name));
        lines.extend(names.map(|name| row(self, name)));
        let WorkerFigures { first_segment_s, rss_bytes, sink_cpu_share, rejected, lost } =
            &self.workers;
        let memory = rss_bytes.map_or_else(
            || "unknown".to_owned(),
            |bytes| format!("{:.0} MB at most", bytes as f64 / 1e6),
        );
        lines.extend([
            String::new(),
            format!("  first segment after {first_segment_s:.2} s; resident memory {memory}"),
            format!("  {rejected} segments rejected, {lost} lost"),
            format!("  draining took {:.1} % of one core", sink_cpu_share * 100.0),
            String::new(),
        ]);
        let notes = self.notes.iter().filter(|(name, _)| self.is_listed(name));
        lines.extend(notes.map(|(name, text)| format!("  {:<10} {text}", label(name))));
        lines.join("\n")
    }

    /// Returns true if `name` applies to these workers and this task.
    fn is_listed(&self, name: &str) -> bool {
        match name {
            ONE_WORKER => self.config.actors.workers > 1,
            PANDA_GYM => is_in_panda_gym(&self.env_id),
            _ => true,
        }
    }
}

fn label(name: &str) -> &str {
    match name {
        ONE_WORKER => "one worker",
        PANDA_GYM => "panda-gym",
        name => name,
    }
}

fn row(figures: &Figures, name: &str) -> String {
    let (rates, Some(rate)) = (figures.rates(name), figures.steps_per_s(name)) else {
        return format!("  {:<10} {:>11}", label(name), "absent");
    };
    let whole = |rate: f64| grouped(rate.round() as u64);
    let workers = if name == ONE_WORKER { 1 } else { figures.config.actors.workers };
    let step_us = 1e6 * workers as f64 / rate;
    let spread = format!("{} … {}", whole(min(&rates)), whole(max(&rates)));
    let ratio = match figures.ratio(name).filter(|_| name != WORKER) {
        Some(ratio) => format!("{ratio:.2} ×"),
        None => String::new(),
    };
    let cpu_us = figures.cpu_us_per_step(name).map_or_else(String::new, |us| format!("{us:.2}"));
    let rate = whole(rate);
    let name = label(name);
    let row = format!("  {name:<10} {rate:>11} {step_us:>9.2} {cpu_us:>9}   {spread:<21} {ratio}");
    row.trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use crate::figures::tests::figures;

    #[test]
    fn table_shows_step_time_per_worker() {
        let text = figures().text();
        let row = |name: &str| {
            let line = text.lines().find(|line| line.trim_start().starts_with(name)).unwrap();
            line.split_whitespace().skip(1).collect::<Vec<_>>().join(" ")
        };
        // Two workers with 180 steps per second together: 11.1 ms per step in each.
        assert_eq!(row("worker"), "180 11111.11 80 … 380");
        assert_eq!(row("ceiling"), "200 10000.00 10000.00 100 … 400 0.90 ×");
        assert_eq!(row("envpool"), "absent");
        assert!(!text.contains("panda-gym"), "only beside a Panda");
        assert!(text.contains("50 MB at most"), "{text}");
    }
}
