//! Stage 8 of 8, the page that shows runs while they are trained and afterwards.
//!
//! ```text
//!  browser ──HTTP──► server ──► answers ──► catalogue ──► watched runs ──► tail, table
//!  Prometheus ─────────┘ └──► page/ (HTML, CSS, scripts in the binary)        run directories
//! ```
//! It only reads run directories and needs nothing of the processes that train. What has been read
//! is kept, so a look at a long run costs what has been added since; a curve is sent as its new
//! points only. A request names a run or a video, and is answered only if a listing has it: no
//! path ever comes from outside.

mod answers;
mod catalogue;
mod configuration;
mod episode;
mod page;
mod prometheus;
mod server;
mod table;
pub(crate) mod tail;
mod videos;
mod watched;

pub use server::{Plan, serve};
