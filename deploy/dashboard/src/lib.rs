//! Stage 8 of 8: the web page that shows runs during and after training.
//!
//! ```text
//!  browser ──HTTP──► server ──► api ──► catalogue ──► cached runs ──► tail, table
//!  Prometheus ─────────┘ └──► page/ (HTML, CSS, scripts in the binary)   run directories
//! ```
//! The dashboard only reads run directories and is independent of the training processes. It caches
//! the data it has read, so a refresh reads only what was appended, and it sends only the new
//! points of a curve. A request needs the dashboard's token, and gives the name of a listed run or
//! video, never a path.

mod access;
mod api;
mod cached_run;
mod catalogue;
mod configuration;
mod episode;
mod page;
mod prometheus;
mod server;
mod table;
mod videos;

pub use server::{Options, serve};
