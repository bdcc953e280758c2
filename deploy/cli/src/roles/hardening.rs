//! Drops privileges of a role before it starts.

use anyhow::Context;
use rustix::process::{Resource, Rlimit, setrlimit};
use rustix::thread::set_no_new_privs;

/// Prevents this process and its children from gaining privileges by a set-user-id program, and
/// disables core dumps. A core dump of a learner would be as large as its replay, and could contain
/// secrets of the user.
pub fn harden() -> anyhow::Result<()> {
    set_no_new_privs(true).context("cannot give up gaining privileges (PR_SET_NO_NEW_PRIVS)")?;
    let none = Rlimit { current: Some(0), maximum: Some(0) };
    setrlimit(Resource::Core, none).context("cannot disable core dumps (RLIMIT_CORE)")
}
