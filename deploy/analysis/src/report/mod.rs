//! `dmprl report`: compares runs, as a web page, Markdown, CSV, JSON and pictures.
//!
//! Layers, each of which uses only those above it:
//!
//! - Data: `run` and `motion_metrics` describe a run, `results` the runs of a report, `paper` the
//!   paper's tables.
//! - Reading: `collect` reads runs and sweeps, `snapshot` the data of earlier reports, `motion` how
//!   policies move.
//! - Measures: `measures` and `thresholds` take the figures of a run, `statistics` summarises them,
//!   `provenance` counts the programs behind them.
//! - Comparison: `tables`, `efficiency`, `curves`, `trajectories`, `filmstrips` and `statements`
//!   compare methods; `layout` has their parts.
//! - Output: `contents` combines them, `sections` orders them for `page` and `markdown`.
//!   `csv_files` and `snapshot` write them for other programs.
//!
//! Reads files only. `cli` starts the processes that roll policies out, through the functions that
//! `measure_motions` and `record_filmstrips` take.

mod collect;
mod contents;
mod csv_files;
mod curves;
mod efficiency;
mod filmstrips;
#[cfg(test)]
mod fixtures;
mod layout;
mod markdown;
mod measures;
mod motion;
mod motion_metrics;
mod overview;
mod page;
mod paper;
mod provenance;
mod results;
mod run;
mod sections;
mod snapshot;
mod statements;
mod statistics;
mod tables;
mod thresholds;
mod trajectories;

pub use contents::Report;
pub use curves::curves;
pub use efficiency::{EfficiencyCell, EfficiencyRow, efficiency};
pub use filmstrips::{
    Filmstrip, PlannedFilmstrip, missing_filmstrips, needs_recording, plan_filmstrips,
    read_filmstrips, record_filmstrips,
};
pub use layout::Picture;
pub use measures::{Measure, MeasureKind};
pub use motion::{UnmeasuredRun, measure_motions, unmeasured};
pub use motion_metrics::{MotionMetrics, Rollout};
pub use results::Results;
pub use run::{Origin, Run, RunKey, Source};
pub use statements::{ClaimResult, Finding, Limits, PaperClaims, Verdict, evaluate_statements};
pub use statistics::Summary;
pub use tables::{Cell, Table, tables};
pub use trajectories::{missing_trajectories, trajectories};
