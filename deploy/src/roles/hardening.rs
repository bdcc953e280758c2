//! What every role gives up before it begins.

use anyhow::Context;
use rustix::process::{Resource, Rlimit, setrlimit};
use rustix::thread::set_no_new_privs;

/// From now on neither this process nor what it starts gains privileges by a set-user-id program,
/// whatever an environment does; and a crash writes no core: a learner's would be as long as its
/// replay, and either holds what the user's environment held.
pub fn harden() -> anyhow::Result<()> {
    set_no_new_privs(true).context("cannot give up gaining privileges (PR_SET_NO_NEW_PRIVS)")?;
    let none = Rlimit { current: Some(0), maximum: Some(0) };
    setrlimit(Resource::Core, none).context("cannot switch core dumps off (RLIMIT_CORE)")
}
