//! The panel below the bar: return, rates, and a line for each process, as many as fit.

use dmprl_control::{EvaluationRow, Progress};
use dmprl_run::format::{grouped, plus_minus};
use dmprl_supervisor::ProcessLine;

/// Characters of a sparkline, from the lowest to the highest value.
const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
/// Maximum length of a sparkline; longer histories are averaged.
const SPARKS_MAX: usize = 24;
/// Width of a line's name.
const NAME_COLUMNS: usize = 10;
/// Lines of the display that are not processes, including the cursor's line below it.
const OTHER_LINES: usize = 4;
/// Size if the terminal does not report it.
const DEFAULT_SIZE: TerminalSize = TerminalSize { columns: 80, rows: 24 };

/// Scope of the figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scope {
    /// The complete run, as reported by its learner.
    Run,
    /// A host without learner and evaluator.
    Host,
}

/// Content of the panel.
pub(super) struct Panel<'a> {
    pub(super) scope: Scope,
    pub(super) progress: &'a Progress,
    /// Evaluations, oldest first.
    pub(super) evaluations: &'a [EvaluationRow],
    pub(super) processes: &'a [ProcessLine],
}

/// Size of a terminal in characters.
#[derive(Debug, Clone, Copy)]
pub(super) struct TerminalSize {
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl TerminalSize {
    /// Returns the size of the terminal on standard error.
    pub(super) fn of_stderr() -> Self {
        let Ok(size) = rustix::termios::tcgetwinsize(std::io::stderr()) else {
            return DEFAULT_SIZE;
        };
        // Many pseudo-terminals report 0 by 0.
        let known = |count: u16, default| if count == 0 { default } else { usize::from(count) };
        Self {
            columns: known(size.ws_col, DEFAULT_SIZE.columns),
            rows: known(size.ws_row, DEFAULT_SIZE.rows),
        }
    }
}

impl Panel<'_> {
    /// Formats the lines, none of them wider than the terminal.
    pub(super) fn lines(&self, size: TerminalSize) -> Vec<String> {
        let mut lines = Vec::new();
        if self.scope == Scope::Run {
            lines.push(self.quality());
        }
        lines.extend(rates(self.progress, self.scope));
        let room = size.rows.saturating_sub(OTHER_LINES + lines.len()).max(1);
        lines.extend(self.process_lines(room));
        lines.into_iter().map(|line| whole_items(&line, size.columns)).collect()
    }

    fn quality(&self) -> String {
        let Some(latest) = self.evaluations.last() else {
            return match self.progress.return_mean {
                Some(mean) => named("return", &format!("{mean:.2} in training, with noise")),
                None => named("return", "no evaluation yet"),
            };
        };
        let returns: Vec<f64> = self.evaluations.iter().map(|row| row.return_mean).collect();
        let best = returns.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut text = format!("{}{SEPARATOR}best {best:.2}", plus_minus(&latest.returns));
        text.push_str(&format!("{SEPARATOR}{}", sparkline(&returns, None)));
        let rates: Option<Vec<f64>> = self.evaluations.iter().map(|row| row.success_rate).collect();
        if let (Some(rate), Some(rates)) = (latest.success_rate, rates) {
            let sparks = sparkline(&rates, Some((0.0, 1.0)));
            let success = format!("success {:.0} %", rate * 100.0);
            text.push_str(&format!("{SEPARATOR}{success}{SEPARATOR}{sparks}"));
        }
        named("return", &text)
    }

    fn process_lines(&self, room: usize) -> Vec<String> {
        let line = |process: &ProcessLine| {
            let restarts = match process.restarts {
                0 => String::new(),
                1 => format!("{SEPARATOR}1 restart"),
                count => format!("{SEPARATOR}{count} restarts"),
            };
            named(&process.name, &format!("{}{restarts}", process.state))
        };
        if self.processes.len() <= room {
            return self.processes.iter().map(line).collect();
        }
        let shown = room.saturating_sub(1);
        let (shown, hidden) = self.processes.split_at(shown);
        let mut counts: Vec<(&str, usize)> = Vec::new();
        for process in hidden {
            match counts.iter_mut().find(|(state, _)| *state == process.state) {
                Some((_, count)) => *count += 1,
                None => counts.push((&process.state, 1)),
            }
        }
        let states: Vec<_> =
            counts.iter().map(|(state, count)| format!("{count} {state}")).collect();
        let rest = named(&format!("{} more", hidden.len()), &states.join(SEPARATOR));
        shown.iter().map(line).chain([rest]).collect()
    }
}

/// Separator between two figures.
pub(super) const SEPARATOR: &str = " · ";

/// Formats rates and failures: at most two lines.
fn rates(progress: &Progress, scope: Scope) -> Vec<String> {
    let trouble = trouble(progress);
    let mut lines = vec![named("rates", &speed(progress, scope).join(SEPARATOR))];
    if !trouble.is_empty() {
        lines.push(named("trouble", &trouble.join(SEPARATOR)));
    }
    lines
}

/// Formats the rates.
pub(super) fn speed(progress: &Progress, scope: Scope) -> Vec<String> {
    let steps = format!("{:.0} steps/s", progress.env_steps_per_s);
    let queued = format!("{} queued", grouped(progress.queued_segments));
    match scope {
        Scope::Run => vec![
            steps,
            format!("{:.0} updates/s", progress.updates_per_s),
            format!("{:.1} samples/insert", progress.samples_per_insert),
            format!("lag {} (max {})", progress.policy_lag_p50, progress.policy_lag_max),
            queued,
        ],
        Scope::Host => vec![
            format!("{steps} here"),
            queued,
            format!("{} segments acknowledged", grouped(progress.segments)),
        ],
    }
}

/// Formats counts of failures; empty if there were none.
pub(super) fn trouble(progress: &Progress) -> Vec<String> {
    let counts = [
        (progress.restarts, "restarts"),
        (progress.rejected, "rejected"),
        (progress.env_failures, "env failures"),
    ];
    let some = counts.into_iter().filter(|(count, _)| *count > 0);
    some.map(|(count, what)| format!("{} {what}", grouped(count))).collect()
}

fn named(name: &str, text: &str) -> String {
    format!("  {name:<NAME_COLUMNS$} {text}")
}

/// Draws one block per value, scaled to `range` or to the values' own range; equal values are flat.
fn sparkline(values: &[f64], range: Option<(f64, f64)>) -> String {
    let per_spark = values.len().div_ceil(SPARKS_MAX).max(1);
    let means: Vec<f64> = values
        .chunks(per_spark)
        .map(|chunk| chunk.iter().sum::<f64>() / chunk.len() as f64)
        .collect();
    let lowest = means.iter().copied().fold(f64::INFINITY, f64::min);
    let highest = means.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let (low, high) = range.unwrap_or((lowest, highest));
    let last = BLOCKS.len() - 1;
    let block = |mean: &f64| {
        let share = if high > low { (mean - low) / (high - low) } else { 0.0 };
        // The cast saturates, and maps NaN to 0.
        BLOCKS[((share * last as f64).round() as usize).min(last)]
    };
    means.iter().map(block).collect()
}

/// Returns as many figures as fit. Only the first can be truncated.
pub(super) fn whole_items(figures: &str, width: usize) -> String {
    let mut line = String::new();
    for item in figures.split(SEPARATOR) {
        if line.is_empty() {
            line.extend(item.chars().take(width));
            continue;
        }
        if line.chars().count() + SEPARATOR.chars().count() + item.chars().count() > width {
            break;
        }
        line.push_str(SEPARATOR);
        line.push_str(item);
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(return_mean: f64, success_rate: Option<f64>) -> EvaluationRow {
        EvaluationRow {
            env_steps: 0,
            updates: 0,
            segments: 0,
            wall_s: 0.0,
            policy_version: 0,
            returns: vec![return_mean - 1.0, return_mean + 1.0],
            return_mean,
            success_rate,
            smoothness: 0.0,
            at_bounds: None,
        }
    }

    fn process(name: &str, state: &str, restarts: u32) -> ProcessLine {
        ProcessLine { name: name.into(), state: state.into(), restarts }
    }

    #[test]
    fn it_shows_returns_rates_and_processes() {
        let progress = Progress {
            env_steps_per_s: 520.4,
            updates_per_s: 205.0,
            samples_per_insert: 12.5,
            policy_lag_p50: 2,
            policy_lag_max: 7,
            queued_segments: 1_024,
            restarts: 2,
            ..Progress::default()
        };
        let rows = [row(-8.0, Some(0.0)), row(-2.0, Some(0.5)), row(-5.0, Some(1.0))];
        let processes = [process("learner", "learning", 0), process("actor-0", "stepping", 2)];
        let scope = Scope::Run;
        let panel = Panel { scope, progress: &progress, evaluations: &rows, processes: &processes };
        let expected = [
            "  return     -5.00 ± 1.00 · best -2.00 · ▁█▅ · success 100 % · ▁▅█",
            "  rates      520 steps/s · 205 updates/s · 12.5 samples/insert · lag 2 (max 7) · \
             1,024 queued",
            "  trouble    2 restarts",
            "  learner    learning",
            "  actor-0    stepping · 2 restarts",
        ];
        assert_eq!(panel.lines(TerminalSize { columns: 100, rows: 24 }), expected);
        let narrow = panel.lines(TerminalSize { columns: 40, rows: 24 });
        assert_eq!(narrow[1], "  rates      520 steps/s · 205 updates/s");
        assert!(narrow.iter().all(|line| line.chars().count() <= 40), "{narrow:?}");
    }

    /// Regression test: a host without a learner once showed 0 updates per second.
    #[test]
    fn on_a_host_it_shows_no_figures_of_the_learner() {
        let progress = Progress {
            env_steps_per_s: 240.2,
            queued_segments: 181,
            segments: 1_008,
            ..Progress::default()
        };
        let processes = [process("relay", "relaying", 0)];
        let scope = Scope::Host;
        let panel = Panel { scope, progress: &progress, evaluations: &[], processes: &processes };
        let expected = [
            "  rates      240 steps/s here · 181 queued · 1,008 segments acknowledged",
            "  relay      relaying",
        ];
        assert_eq!(panel.lines(TerminalSize { columns: 100, rows: 24 }), expected);
    }

    #[test]
    fn processes_that_do_not_fit_are_counted_by_state() {
        let progress = Progress::default();
        let mut processes: Vec<_> =
            (0..32).map(|index| process(&format!("actor-{index}"), "stepping", 0)).collect();
        processes[30] = process("actor-30", "starting", 0);
        let scope = Scope::Run;
        let panel = Panel { scope, progress: &progress, evaluations: &[], processes: &processes };
        let lines = panel.lines(TerminalSize { columns: 80, rows: 16 });
        assert!(lines.len() + OTHER_LINES <= 16, "{lines:?}");
        assert_eq!(lines.last().unwrap(), "  23 more    22 stepping · 1 starting");
        assert_eq!(lines[0], "  return     no evaluation yet");
        let low = panel.lines(TerminalSize { columns: 80, rows: 3 });
        assert_eq!(low.last().unwrap(), "  32 more    31 stepping · 1 starting");
    }

    #[test]
    fn sparklines_span_their_values_and_average_long_histories() {
        assert_eq!(sparkline(&[0.0, 7.0], None), "▁█");
        assert_eq!(sparkline(&[3.0, 3.0], None), "▁▁");
        assert_eq!(sparkline(&[0.5], Some((0.0, 1.0))), "▅");
        assert_eq!(sparkline(&[f64::NAN], None), "▁");
        let long: Vec<f64> = (0..1_000).map(f64::from).collect();
        let sparks = sparkline(&long, None);
        assert!(sparks.chars().count() <= SPARKS_MAX && sparks.starts_with('▁'), "{sparks}");
        assert!(sparks.ends_with('█'), "{sparks}");
    }

    #[test]
    fn a_narrow_terminal_drops_whole_figures() {
        assert_eq!(
            whole_items("12 steps · eta 3 s · 5 steps/s", 100),
            "12 steps · eta 3 s · 5 steps/s"
        );
        assert_eq!(whole_items("12 steps · eta 3 s · 5 steps/s", 20), "12 steps · eta 3 s");
        assert_eq!(whole_items("12 steps · eta 3 s · 5 steps/s", 10), "12 steps");
        assert_eq!(whole_items("12 steps", 3), "12 ");
    }
}
