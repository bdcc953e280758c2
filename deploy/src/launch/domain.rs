//! The run's private shared-memory directory: the one place that makes and removes it.

use std::path::{Path, PathBuf};

use anyhow::Context;
use dmprl_shared::transport::shared_memory::{Domain, remove_abandoned};

/// Where the domains of this user lie: memory-backed when the system has it.
fn parent() -> PathBuf {
    let uid = rustix::process::getuid().as_raw();
    let shared_memory = Path::new("/dev/shm");
    let base = if shared_memory.is_dir() { shared_memory.to_owned() } else { std::env::temp_dir() };
    base.join(format!("dmprl-{uid}"))
}

/// Removes what dead runs have left, then makes a directory for this one.
///
/// # Errors
/// The directory cannot be made, or someone else has made it.
pub(crate) fn create(token: &str) -> anyhow::Result<Domain> {
    let parent = parent();
    remove_abandoned(&parent).with_context(|| {
        format!("cannot remove what dead runs have left in {}", parent.display())
    })?;
    Domain::create(&parent, token)
        .with_context(|| format!("cannot make shared memory in {}", parent.display()))
}
