//! `dmprl report`: what several runs have shown, as one page, Markdown, CSV and pictures.
//!
//! `collect` reads runs and sweeps, `tables` and `curves` say what they show, `statistics` how sure
//! one can be, `paper` what the paper has; `page` writes it all.

mod collect;
mod curves;
mod page;
mod paper;
mod statistics;
mod tables;

pub use collect::{Results, Run};
pub use curves::{Curves, curves};
pub use page::Report;
pub use statistics::Summary;
pub use tables::{Cell, Table, tables};
