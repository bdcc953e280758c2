//! The run directory, and code that all commands share: errors, number formats, progress and sweep
//! files.
//!
//! The other crates of `deploy` build on this one. It starts no process and draws nothing.

mod atomic;
mod command_line;
mod directory;
mod exit_status;
pub mod failure;
mod file_system;
pub mod format;
mod lock;
mod log_tail;
mod manifest;
mod policies;
mod policy_copy;
mod processes;
mod processor;
mod progress;
pub mod project;
mod provenance;
mod random;
mod rows;
pub mod secret_file;
mod setup;
pub mod sweep_files;
pub mod tail;
mod timestamp;
mod title;
mod watch;
mod zoo;

pub use atomic::replace as replace_file;
pub use command_line::words_after_program;
pub use directory::{RunDirectory, TOKEN_FILE, safe_name};
pub use exit_status::{ENV_HUNG_STATUS, PANIC_STATUS, describe};
pub use file_system::FileSystem;
pub use lock::{Holder, LEASE_TIMEOUT, LockWatch, RunLock};
pub use log_tail::last_lines;
pub use manifest::{FORMAT_VERSION, Machine, Manifest, Packages, Session};
pub use policies::{ChosenPolicy, PolicyChoice};
pub use processes::{ProcessRow, ProcessState, Processes};
pub use progress::{NoProgress, Progress};
pub use provenance::NamedCode;
pub use random::random_u64;
pub use setup::Setup;
pub use timestamp::{compact, compact_now, now_rfc3339, rfc3339, unix_s};
pub use title::{method_label, title};
pub use watch::{Interrupted, Watch, is_ignored};
pub use zoo::Zoo;
