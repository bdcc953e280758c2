//! Flags that determine how a run shows its progress.

use clap::{Args, ValueEnum};
use dmprl_shared::config::RunConfig;
use dmprl_supervisor::RunObserver;

use crate::terminal::{Display, ProgressStyle, events};

/// Flags of `train`, `resume` and `bridge`.
#[derive(Debug, Clone, Copy, Args)]
pub(super) struct OutputArgs {
    /// Print lines instead of a progress bar.
    #[arg(long)]
    no_progress: bool,
    /// Write events to standard error, one JSON object per line, instead of text (docs/runs.md).
    #[arg(long, value_name = "FORMAT")]
    events: Option<EventFormat>,
}

/// Formats of `--events`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum EventFormat {
    /// One JSON object per line.
    Json,
}

impl OutputArgs {
    /// The style that the flags select.
    pub(super) fn style(self) -> ProgressStyle {
        match self {
            Self { events: Some(EventFormat::Json), .. } => ProgressStyle::Events,
            Self { no_progress: true, .. } => ProgressStyle::Lines,
            Self { .. } => ProgressStyle::Automatic,
        }
    }
}

/// Makes the observer of a run in this style.
pub(super) fn observer(style: ProgressStyle, run: &RunConfig) -> Box<dyn RunObserver> {
    match style {
        ProgressStyle::Events => Box::new(events::EventLines::new()),
        style => Box::new(Display::new(style, run.steps).within(run.max_minutes)),
    }
}

/// Makes the observer of a host without a learner in this style.
pub(super) fn host_observer(style: ProgressStyle, run: &RunConfig) -> Box<dyn RunObserver> {
    match style {
        ProgressStyle::Events => observer(style, run),
        style => Box::new(Display::new(style, run.steps).of_host()),
    }
}
