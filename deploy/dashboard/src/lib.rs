//! Stage 8 of 8: the web page that shows runs during and after training.
//!
//! ```text
//!  browser ──HTTP──► server ──► answers ──► catalogue ──► watched runs ──► tail, table
//!  Prometheus ─────────┘ └──► page/ (HTML, CSS, scripts in the binary)        run directories
//! ```
//! The dashboard only reads run directories and is independent of the training processes. It caches
//! the data it has read, so that refreshing a long run costs only the added part, and it sends only
//! the new points of a curve. A request names a run or a video and is answered only if it is
//! listed: no path ever comes from a client.

mod answers;
mod catalogue;
mod configuration;
mod episode;
mod page;
mod prometheus;
mod server;
mod table;
pub(crate) mod videos;
mod watched;

pub use server::{Plan, serve};
