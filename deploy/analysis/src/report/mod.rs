//! `dmprl report`: compares runs in a web page, Markdown, CSV, JSON and pictures.
//!
//! The layers, each of which uses only those above it:
//!
//! - Data: `run` and `motion_metrics` describe a run, `results` holds the runs of a report, `paper`
//!   the paper's tables.
//! - Input: `collect` reads runs and sweeps, `snapshot` the data of earlier reports, `motion` the
//!   measured motions.
//! - Measures: `measures` and `thresholds` compute the figures of a run, `statistics` summarises
//!   them over seeds, `provenance` counts the program versions behind them.
//! - Comparison: `tables`, `efficiency`, `curves`, `pareto`, `trajectories`, `filmstrips` and
//!   `statements` compare methods, with the elements of `layout`. `families` groups the methods of
//!   a grid.
//! - Output: `contents` combines the parts, `findings` states a conclusion of each, `sections`
//!   orders them for `page` and `markdown`.
//!   `csv_files` and `snapshot` write the data for other programs and later reports.
//!
//! The module only reads and writes files. Where a policy must be rolled out, the caller passes a
//! function (`measure_motions`, `record_filmstrips`).

mod collect;
mod contents;
mod csv_files;
mod curves;
mod efficiency;
mod families;
mod filmstrips;
mod findings;
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
mod pareto;
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
pub use curves::{Curves, curves};
pub use efficiency::{EfficiencyCell, EfficiencyRow, efficiency};
pub use filmstrips::{
    Filmstrip, PlannedFilmstrip, missing_filmstrips, needs_recording, plan_filmstrips,
    read_filmstrips, record_filmstrips,
};
pub use layout::Picture;
pub use measures::{Measure, MeasureKind};
pub use motion::{UnmeasuredRun, measure_motions, unmeasured};
pub use motion_metrics::{MotionMetrics, Rollout};
pub use pareto::pareto;
pub use results::Results;
pub use run::{Origin, Run, RunKey, Source};
pub use statements::{ClaimResult, Finding, Limits, PaperClaims, Verdict, evaluate_statements};
pub use statistics::Summary;
pub use tables::{Cell, Table, tables};
pub use trajectories::{missing_trajectories, trajectories};
