//! `dmprl report`: what several runs have shown, as one page, Markdown, CSV, JSON and pictures.
//!
//! `collect` reads runs and sweeps, `motion` measures how they move; `measures` says what is
//! measured of a run, `tables`, `efficiency`, `curves`, `trajectories`, `strips` and `statements`
//! what that shows, `statistics` how sure one can be; `paper` and `thresholds` are what the paper
//! has. `sections` puts it in order for `page` and `markdown`, `data` writes it for other programs.

mod collect;
mod curves;
mod data;
mod efficiency;
mod markdown;
mod measures;
mod motion;
mod overview;
mod page;
mod paper;
#[cfg(test)]
mod planted;
mod sections;
mod statements;
mod statistics;
mod strips;
mod tables;
mod thresholds;
mod trajectories;

pub(crate) use collect::label as method_label;
pub use collect::{Origin, Results, Run};
pub use curves::curves;
pub use efficiency::{EfficiencyCell, EfficiencyRow, efficiency};
pub use measures::Measure;
pub use motion::{measure_motions, unmeasured};
pub use page::Report;
pub use sections::Picture;
pub use statements::{Finding, Judged, Verdict, judge};
pub use statistics::Summary;
pub use strips::{Strip, Wanted, draw, strips, undrawn, wanted};
pub use tables::{Cell, Table, tables};
pub use trajectories::trajectories;
