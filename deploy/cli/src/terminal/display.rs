//! Progress of a run: a bar with a panel below it in a terminal, periodic lines elsewhere.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use dmprl_control::{EvaluationRow, Progress};
use dmprl_run::format::{duration, grouped, plus_minus};
use dmprl_supervisor::{ProcessLine, RunEvent, RunObserver};
use indicatif::{ProgressBar, ProgressStyle as BarStyle};

use super::panel::{Panel, SEPARATOR, Scope, TerminalSize, speed, trouble, whole_items};

/// Interval between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// Interval between two redraws of the bar without new reports.
const REDRAW_INTERVAL: Duration = Duration::from_millis(200);
/// Columns of the bar, the percentage and the spaces around them.
const BAR_COLUMNS: usize = 27;

/// Style of the progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressStyle {
    /// A bar if standard error is a terminal.
    Automatic,
    /// Always lines.
    Lines,
    /// Events as JSON, one object per line, instead of a display.
    Events,
}

/// Display of a run's progress.
pub struct Display {
    target: Target,
    scope: Scope,
    steps_total: u64,
    /// When the time limit of the run ends it.
    ends: Option<Instant>,
    line_at: Option<Instant>,
    /// Evaluations, oldest first.
    evaluations: Vec<EvaluationRow>,
    /// The last progress shown.
    last: Progress,
}

enum Target {
    Bar(ProgressBar),
    Lines(Box<dyn Write + Send>),
}

impl Display {
    /// Creates the display on standard error.
    #[must_use]
    pub fn new(style: ProgressStyle, steps_total: u64) -> Self {
        if style == ProgressStyle::Automatic && std::io::stderr().is_terminal() {
            let bar = ProgressBar::new(steps_total);
            // The template is a constant; if it were invalid, indicatif's default would be used.
            if let Ok(style) = BarStyle::with_template("{bar:20.cyan/dim} {percent:>3}% {msg}") {
                bar.set_style(style.progress_chars("━━╌"));
            }
            bar.set_message("starting");
            bar.enable_steady_tick(REDRAW_INTERVAL);
            return Self::on(Target::Bar(bar), steps_total);
        }
        Self::lines(Box::new(std::io::stderr()), steps_total)
    }

    /// Restricts the display to a host without a learner.
    #[must_use]
    pub fn of_host(self) -> Self {
        Self { scope: Scope::Host, ..self }
    }

    /// Sets the time limit of the run, which starts now \[min\]; inf: none.
    #[must_use]
    pub fn within(self, minutes: f64) -> Self {
        let limit = Duration::try_from_secs_f64(minutes * 60.0).ok();
        Self { ends: limit.and_then(|limit| Instant::now().checked_add(limit)), ..self }
    }

    /// Writes plain lines to any writer.
    #[must_use]
    pub fn lines(writer: Box<dyn Write + Send>, steps_total: u64) -> Self {
        Self::on(Target::Lines(writer), steps_total)
    }

    fn on(target: Target, steps_total: u64) -> Self {
        Self {
            target,
            scope: Scope::Run,
            steps_total,
            ends: None,
            line_at: None,
            evaluations: Vec::new(),
            last: Progress::default(),
        }
    }

    /// Returns true if there is a panel with the processes.
    fn is_live(&self) -> bool {
        matches!(self.target, Target::Bar(_))
    }

    /// Updates the list of processes between two reports of progress.
    fn refresh(&mut self, processes: &[ProcessLine]) {
        if self.is_live() {
            let last = std::mem::take(&mut self.last);
            self.progress(&last, processes);
        }
    }

    /// Prints a message above the bar.
    fn message(&mut self, text: &str) {
        match &mut self.target {
            Target::Bar(bar) => bar.suspend(|| super::say(text)),
            Target::Lines(writer) => write_line(writer, text),
        }
    }

    /// Shows the learner's progress and, if there is a panel, the processes.
    fn progress(&mut self, progress: &Progress, processes: &[ProcessLine]) {
        let (steps, figures) = (self.steps(progress), self.figures(progress));
        self.last = progress.clone();
        match &mut self.target {
            Target::Bar(bar) => {
                bar.set_position(progress.env_steps.min(self.steps_total));
                let size = TerminalSize::of_stderr();
                let (scope, evaluations) = (self.scope, self.evaluations.as_slice());
                let panel = Panel { scope, progress, evaluations, processes };
                let head = whole_items(&steps, size.columns.saturating_sub(BAR_COLUMNS));
                let lines = std::iter::once(head).chain(panel.lines(size));
                bar.set_message(lines.collect::<Vec<_>>().join("\n"));
            }
            Target::Lines(writer) => {
                let now = Instant::now();
                if self.line_at.is_some_and(|at| now.duration_since(at) < LINE_INTERVAL) {
                    return;
                }
                self.line_at = Some(now);
                // The last segment can exceed the run's length.
                let done = progress.env_steps.min(self.steps_total);
                let percent = done * 100 / self.steps_total.max(1);
                write_line(writer, &format!("{percent:>3}% {steps}{SEPARATOR}{figures}"));
            }
        }
    }

    /// Removes the bar.
    fn close(&mut self) {
        if let Target::Bar(bar) = &self.target {
            bar.finish_and_clear();
        }
    }

    /// Formats steps and remaining time.
    fn steps(&self, progress: &Progress) -> String {
        let steps = format!("{}/{} steps", grouped(progress.env_steps), grouped(self.steps_total));
        let left = self.steps_total.saturating_sub(progress.env_steps) as f64;
        let limit = self.ends.map(|ends| ends.saturating_duration_since(Instant::now()));
        let eta = limit
            .map_or(f64::INFINITY, |limit| limit.as_secs_f64())
            .min(left / progress.env_steps_per_s);
        // No remaining time for a rate of zero, for more than three years, or for a host, which has
        // only part of the run's workers.
        if self.scope == Scope::Run && (1e-9..1e8).contains(&eta) {
            return format!("{steps}{SEPARATOR}eta {}", duration(Duration::from_secs_f64(eta)));
        }
        steps
    }

    /// Formats the rest of a plain line.
    fn figures(&self, progress: &Progress) -> String {
        let mut parts = Vec::new();
        match (self.evaluations.last(), progress.return_mean) {
            (Some(row), _) => parts.push(format!("return {}", plus_minus(&row.returns))),
            (None, Some(mean)) => parts.push(format!("return {mean:.2} (training)")),
            (None, None) => {}
        }
        parts.extend(speed(progress, self.scope));
        parts.extend(trouble(progress));
        parts.join(SEPARATOR)
    }
}

impl RunObserver for Display {
    fn on_event(&mut self, event: RunEvent) {
        let message = event.to_string();
        if !message.is_empty() {
            self.message(&message);
        }
        match event {
            RunEvent::Started { evaluations, .. } | RunEvent::Rewound { evaluations } => {
                self.evaluations = evaluations;
            }
            RunEvent::Progress { progress, processes } => self.progress(&progress, &processes),
            RunEvent::Processes(processes) => self.refresh(&processes),
            RunEvent::Evaluated { row, .. } => self.evaluations.push(row),
            RunEvent::Ended => self.close(),
            _ => {}
        }
    }

    fn shows_processes(&self) -> bool {
        self.is_live()
    }
}

/// Writes a line. Ignores errors: a closed standard error must not end the run.
fn write_line(writer: &mut Box<dyn Write + Send>, text: &str) {
    let _ = writeln!(writer, "{text}").and_then(|()| writer.flush());
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io;
    use std::sync::{Arc, Mutex};

    #[derive(Clone, Default)]
    struct Shared(Arc<Mutex<Vec<u8>>>);

    impl Write for Shared {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_line_has_all_figures_and_lines_are_rate_limited() {
        let shared = Shared::default();
        let mut display = Display::lines(Box::new(shared.clone()), 1_000);
        let progress = Progress {
            env_steps: 250,
            env_steps_per_s: 50.0,
            updates_per_s: 20.0,
            samples_per_insert: 12.5,
            policy_lag_p50: 2,
            policy_lag_max: 7,
            queued_segments: 1_024,
            restarts: 3,
            ..Progress::default()
        };
        display.progress(&progress, &[]);
        display.progress(&progress, &[]);
        let text = String::from_utf8(shared.0.lock().unwrap().clone()).unwrap();
        let rates = "50 steps/s · 20 updates/s · 12.5 samples/insert · lag 2 (max 7) · \
                     1,024 queued · 3 restarts";
        assert_eq!(text, format!(" 25% 250/1,000 steps · eta 15 s · {rates}\n"));
    }

    #[test]
    fn a_host_shows_no_remaining_time() {
        let display = Display::lines(Box::new(Shared::default()), 1_000).of_host();
        let progress =
            Progress { env_steps: 250, env_steps_per_s: 50.0, segments: 10, ..Progress::default() };
        assert_eq!(display.steps(&progress), "250/1,000 steps");
        let figures = display.figures(&progress);
        assert_eq!(figures, "50 steps/s here · 0 queued · 10 segments acknowledged");
    }

    #[test]
    fn a_run_with_a_time_limit_shows_the_time_left_of_it() {
        let display = Display::lines(Box::new(Shared::default()), 1_000_000).within(120.0);
        let shown = |env_steps_per_s| {
            display.steps(&Progress { env_steps: 1, env_steps_per_s, ..Progress::default() })
        };
        for slow in [0.0, 1.0] {
            let text = shown(slow);
            let minutes = text.split_once("eta 1 h ").map(|(_, minutes)| minutes.to_owned());
            assert_eq!(minutes.as_deref(), Some("59 min"), "{text}");
        }
        assert!(shown(1e5).ends_with("eta 9 s"), "{}", shown(1e5));
    }

    #[test]
    fn a_rate_of_zero_shows_no_remaining_time() {
        let display = Display::lines(Box::new(Shared::default()), 1_000);
        for rate in [0.0, -1.0, f64::NAN, 1e-9] {
            let progress = Progress { env_steps_per_s: rate, ..Progress::default() };
            let figures = display.steps(&progress);
            assert!(!figures.contains("eta"), "{rate}: {figures}");
        }
    }
}
