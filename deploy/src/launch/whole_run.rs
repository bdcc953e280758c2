//! A whole `dmprl train` as a child: what `dmprl chaos` strikes and `dmprl bench system` measures.

use std::fs::File;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use rustix::process::{Pid, Signal, kill_process};

use super::child::describe;
use super::logs::last_lines;

/// From SIGINT to the end; the supervisor has limits of its own.
const END: Duration = Duration::from_secs(90);
/// Between two looks for the end.
const LOOK: Duration = Duration::from_millis(10);

/// A running `dmprl train`. Dropped, it is killed, and its children end by themselves.
pub(crate) struct WholeRun {
    child: Child,
    log: PathBuf,
}

impl WholeRun {
    /// Starts it. `command` says everything: variables of the caller's environment that would
    /// configure a run are not passed on.
    pub(crate) fn start(mut command: Command, log: &Path) -> anyhow::Result<Self> {
        let file = File::create(log).with_context(|| format!("cannot make {}", log.display()))?;
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("DMPRL_") {
                command.env_remove(name);
            }
        }
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(file);
        // A session of its own: Ctrl-C is for us, and the kernel must not wake its stopped members.
        // SAFETY: both are system calls, allocate nothing and touch no lock.
        unsafe {
            command.pre_exec(|| {
                rustix::process::setsid()?;
                // When this program is killed the run comes to its end by itself.
                rustix::process::set_parent_process_death_signal(Some(Signal::INT))?;
                Ok(())
            });
        }
        let child = command.spawn().context("cannot start dmprl train")?;
        Ok(Self { child, log: log.to_owned() })
    }

    /// The supervisor.
    pub(crate) fn pid(&self) -> anyhow::Result<Pid> {
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw);
        pid.context("a child without an id")
    }

    /// How it has ended by itself, if it has.
    pub(crate) fn end(&mut self) -> anyhow::Result<Option<String>> {
        let status = self.child.try_wait().context("cannot wait for dmprl train")?;
        Ok(status.map(|status| self.told(status)))
    }

    fn told(&self, status: ExitStatus) -> String {
        let (how, lines) = (describe(status), last_lines(&self.log));
        format!("{how}; the last lines of {}:\n{lines}", self.log.display())
    }

    /// Stops it as Ctrl-C does; returns what was wrong about its end.
    pub(crate) fn stop(&mut self) -> anyhow::Result<Option<String>> {
        let pid = self.pid()?;
        kill_process(pid, Signal::INT).context("cannot interrupt dmprl train")?;
        let deadline = Instant::now() + END;
        loop {
            if let Some(status) = self.child.try_wait().context("cannot wait for dmprl train")? {
                let regular = status.code() == Some(130);
                return Ok((!regular).then(|| self.told(status)));
            }
            if Instant::now() >= deadline {
                self.child.kill().context("cannot kill dmprl train")?;
                let status = self.child.wait().context("cannot wait for dmprl train")?;
                return Ok(Some(format!("not within {END:?} of SIGINT; {}", self.told(status))));
            }
            std::thread::sleep(LOOK);
        }
    }
}

impl Drop for WholeRun {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
