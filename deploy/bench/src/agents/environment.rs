//! The Python environment of the peers, made when it is first needed.

use std::fs::File;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_run::{Progress, Watch, describe, last_lines};
use rustix::process::{Pid, Signal, kill_process_group};

use super::AgentsBench;

/// Maximum duration of the installation. PyTorch and its libraries are several gigabytes.
const INSTALLATION: Duration = Duration::from_secs(3600);
/// Interval between checks for the exit of a command.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);
/// Requirements of the peers, next to their script. A copy in the environment shows that it is
/// complete.
const REQUIREMENTS: &str = "agents.txt";

/// Returns the interpreter of the peers' environment, which is made if it is missing, incomplete,
/// or made for other requirements.
pub(super) fn prepare(
    bench: &AgentsBench,
    watch: &Watch,
    progress: &dyn Progress,
) -> anyhow::Result<PathBuf> {
    let folder = &bench.environment;
    let python = folder.join("bin/python");
    let required = bench.peers_path.join(REQUIREMENTS);
    let wanted = std::fs::read(&required)
        .with_context(|| format!("cannot read the peers' requirements {}", required.display()))?;
    let complete = folder.join(REQUIREMENTS);
    let path = folder.with_extension("lock");
    let lock = File::create(&path).with_context(|| format!("cannot create {}", path.display()))?;
    if lock.try_lock().is_err() {
        bail!("another benchmark is installing the peers into {}", folder.display());
    }
    // The interpreter is a link, whose target an upgrade may have removed.
    let is_complete = std::fs::read(&complete).is_ok_and(|made_for| made_for == wanted);
    if is_complete && python.exists() {
        return Ok(python);
    }
    progress.stage(&format!(
        "installing the peers into {} (several gigabytes, once; another environment: \
         --peer-python)",
        folder.display()
    ));
    if folder.exists() {
        std::fs::remove_dir_all(folder)
            .with_context(|| format!("cannot remove {}", folder.display()))?;
    }
    let mut venv = Command::new(&bench.python);
    venv.args(["-m", "venv"]).arg(folder);
    let log = folder.with_extension("log");
    run(venv, &log, watch)?;
    let mut pip = Command::new(&python);
    pip.args([
        "-m",
        "pip",
        "install",
        "--disable-pip-version-check",
        "--no-input",
        "--requirement",
    ]);
    pip.arg(&required);
    run(pip, &log, watch)?;
    std::fs::write(&complete, wanted)
        .with_context(|| format!("cannot write {}", complete.display()))?;
    // It was useful only in case of an error.
    let _ = std::fs::remove_file(log);
    Ok(python)
}

/// Kills its process and the processes that it started when it is dropped, for instance after an
/// interrupt.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        // An error means that all have exited already.
        if let Some(group) = i32::try_from(self.0.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process_group(group, Signal::KILL);
        }
        let _ = self.0.wait();
    }
}

fn run(mut command: Command, log: &Path, watch: &Watch) -> anyhow::Result<()> {
    let what = format!("{command:?}");
    let file = File::create(log).with_context(|| format!("cannot create {}", log.display()))?;
    let errors = file.try_clone().context("cannot use a log twice")?;
    command.stdin(Stdio::null()).stdout(file).stderr(errors).process_group(0);
    let mut child = Killed(command.spawn().with_context(|| format!("cannot start {what}"))?);
    let deadline = Instant::now() + INSTALLATION;
    loop {
        watch.check()?;
        if let Some(status) = child.0.try_wait().context("cannot wait for a command")? {
            if status.success() {
                return Ok(());
            }
            bail!(
                "cannot install the peers: {what}: {}; the last lines of {}:\n{}\nAnother \
                 environment can be named with --peer-python",
                describe(status),
                log.display(),
                last_lines(log)
            );
        }
        if Instant::now() >= deadline {
            bail!("cannot install the peers: {what} took more than {INSTALLATION:?}");
        }
        std::thread::sleep(CHECK_INTERVAL);
    }
}
