//! Runs a whole `dmprl train` as a child, for `dmprl chaos` and `dmprl bench`.

use std::fs::File;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_run::describe;
use dmprl_run::last_lines;
use rustix::process::{Pid, Signal, kill_process};

/// Maximum time from SIGINT to the exit, longer than the supervisor's own limits.
const EXIT_LIMIT: Duration = Duration::from_secs(90);
/// Interval between checks for the exit.
const CHECK_INTERVAL: Duration = Duration::from_millis(10);

/// A running `dmprl train`. Dropping it kills the supervisor; its children then exit by themselves.
pub struct WholeRun {
    child: Child,
    log: PathBuf,
}

impl WholeRun {
    /// Starts the command, without the environment variables that would configure a run.
    pub fn start(mut command: Command, log: &Path) -> anyhow::Result<Self> {
        let file = File::create(log).with_context(|| format!("cannot create {}", log.display()))?;
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("DMPRL_") {
                command.env_remove(name);
            }
        }
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(file);
        // In its own session it does not receive Ctrl-C, and the kernel does not wake its stopped
        // members. SAFETY: both are system calls that neither allocate nor take a lock.
        unsafe {
            command.pre_exec(|| {
                rustix::process::setsid()?;
                // The run is interrupted if this program is killed.
                rustix::process::set_parent_process_death_signal(Some(Signal::INT))?;
                Ok(())
            });
        }
        let child = command.spawn().context("cannot start dmprl train")?;
        Ok(Self { child, log: log.to_owned() })
    }

    /// Process id of the supervisor.
    pub fn pid(&self) -> anyhow::Result<Pid> {
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw);
        pid.context("a child without an id")
    }

    /// Describes the exit; `None` if the run has not exited.
    pub fn end(&mut self) -> anyhow::Result<Option<String>> {
        let status = self.child.try_wait().context("cannot wait for dmprl train")?;
        Ok(status.map(|status| self.describe(status)))
    }

    /// Returns whether the run succeeded, with a description of a failure; `None` if it has not
    /// exited.
    pub fn outcome(&mut self) -> anyhow::Result<Option<Result<(), String>>> {
        let status = self.child.try_wait().context("cannot wait for dmprl train")?;
        Ok(status.map(|it| if it.success() { Ok(()) } else { Err(self.describe(it)) }))
    }

    fn describe(&self, status: ExitStatus) -> String {
        let (how, lines) = (describe(status), last_lines(&self.log));
        format!("{how}; the last lines of {}:\n{lines}", self.log.display())
    }

    /// Stops the run with SIGINT. Describes the exit if its status is not 130.
    pub fn stop(&mut self) -> anyhow::Result<Option<String>> {
        let pid = self.pid()?;
        kill_process(pid, Signal::INT).context("cannot interrupt dmprl train")?;
        let deadline = Instant::now() + EXIT_LIMIT;
        loop {
            if let Some(status) = self.child.try_wait().context("cannot wait for dmprl train")? {
                let regular = status.code() == Some(130);
                return Ok((!regular).then(|| self.describe(status)));
            }
            if Instant::now() >= deadline {
                self.child.kill().context("cannot kill dmprl train")?;
                let status = self.child.wait().context("cannot wait for dmprl train")?;
                return Ok(Some(format!(
                    "no exit within {EXIT_LIMIT:?} of SIGINT; {}",
                    self.describe(status)
                )));
            }
            std::thread::sleep(CHECK_INTERVAL);
        }
    }
}

impl Drop for WholeRun {
    fn drop(&mut self) {
        // An error means that it has exited already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
