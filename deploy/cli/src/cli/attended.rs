//! Runs another program in the foreground, and forwards the user's interrupt to it.

use std::os::unix::process::CommandExt;
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_run::Watch;
use rustix::process::{Pid, Signal, kill_process};

/// Interval between checks for exit and interrupt.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);
/// Grace period after the interrupt, before the program is killed.
const GRACE_PERIOD: Duration = Duration::from_secs(5);

/// Runs a program until it ends; returns its status, or `None` if the user interrupted.
pub(super) fn attend(mut command: Command) -> anyhow::Result<Option<ExitStatus>> {
    let watch = Watch::start()?;
    // The program has its own process group, so that it does not get the terminal's interrupt; this
    // process forwards it once.
    command.process_group(0);
    // SAFETY: `prctl` is async-signal-safe, allocates nothing and touches no lock.
    unsafe {
        command.pre_exec(|| {
            rustix::process::set_parent_process_death_signal(Some(Signal::TERM)).map_err(Into::into)
        });
    }
    let mut child = command.stdin(Stdio::null()).spawn().context("cannot start Python")?;
    let id = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
    let mut interrupted_at: Option<Instant> = None;
    loop {
        if let Some(status) = child.try_wait().context("cannot wait for Python")? {
            return Ok(interrupted_at.is_none().then_some(status));
        }
        match interrupted_at {
            None if watch.check().is_err() => {
                interrupted_at = Some(Instant::now());
                // Fails harmlessly if the program has exited meanwhile.
                let _ = id.map(|id| kill_process(id, Signal::INT));
            }
            Some(at) if at.elapsed() > GRACE_PERIOD => {
                let _ = child.kill();
            }
            _ => {}
        }
        std::thread::sleep(CHECK_INTERVAL);
    }
}
