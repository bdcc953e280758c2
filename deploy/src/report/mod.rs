//! `dmprl report`: what several runs have shown, as one page, Markdown, CSV, JSON and pictures.
//!
//! - Input: `collect` reads runs and sweeps, `landed` the data of earlier reports. `motion`
//!   measures how policies move. `run` and `moves` describe one run, `provenance` the programs
//!   behind several.
//! - Analysis: `measures` takes the figures of a run. `tables`, `efficiency`, `curves`,
//!   `trajectories`, `strips` and `statements` compare methods, with `statistics`. `paper` and
//!   `thresholds` hold the paper's figures.
//! - Output: `sections` orders the report for `page` and `markdown`. `data` and `landed` write it
//!   for other programs.

mod collect;
mod curves;
mod data;
mod efficiency;
mod landed;
mod markdown;
mod measures;
mod motion;
mod moves;
mod overview;
mod page;
mod paper;
#[cfg(test)]
mod planted;
mod provenance;
mod run;
mod sections;
mod statements;
mod statistics;
mod strips;
mod tables;
mod thresholds;
mod trajectories;

pub use collect::Results;
pub(crate) use collect::label as method_label;
pub use curves::curves;
pub use efficiency::{EfficiencyCell, EfficiencyRow, efficiency};
pub use measures::Measure;
pub use motion::{measure_motions, unmeasured};
pub use moves::{Moves, Rollout};
pub use page::Report;
pub use run::{Key, Origin, Run, Source};
pub use sections::Picture;
pub use statements::{Finding, Judged, Verdict, judge};
pub use statistics::Summary;
pub use strips::{Strip, Wanted, draw, lost_strips, strips, undrawn, wanted};
pub use tables::{Cell, Table, tables};
pub use trajectories::{lost_trajectories, trajectories};
