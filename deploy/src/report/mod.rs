//! `dmprl report`: what several runs have shown, as one page, Markdown, CSV, JSON and pictures.
//!
//! `collect` reads runs and sweeps, `landed` what an earlier report knew of some, `motion` measures
//! how they move; `run` and `moves` are what is known of one, `provenance` what made them; `measures` says what is measured of
//! it, `tables`, `efficiency`, `curves`, `trajectories`, `strips` and `statements` what that shows,
//! `statistics` how sure one can be; `paper` and `thresholds` are what the paper has. `sections`
//! puts it in order for `page` and `markdown`, `data` and `landed` write it for other programs.

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
