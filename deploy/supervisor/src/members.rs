//! Finds the processes of a run in /proc, for `chaos` and `bench system`, which do not supervise
//! the run themselves.

use std::fs;

use anyhow::Context;
use dmprl_run::words_after_program;
use rustix::process::{Pid, Signal, kill_process};

/// Role of a process in its run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// A worker, by index and incarnation.
    Worker(u32, u32),
    /// A learner, by its number of restarts.
    Learner(u64),
    /// The evaluator.
    Evaluator,
}

/// A child of the supervisor.
#[derive(Debug, Clone, Copy)]
pub struct Member {
    /// Its role in the run.
    pub role: Role,
    pid: Pid,
}

impl Member {
    /// Sends a signal; returns false if the process is gone.
    pub fn signal(&self, signal: Signal) -> bool {
        kill_process(self.pid, signal).is_ok()
    }

    /// Process id.
    pub fn pid(&self) -> Pid {
        self.pid
    }
}

/// Lists the supervisor's children that have started a role already.
pub fn members(supervisor: Pid) -> anyhow::Result<Vec<Member>> {
    let entries = fs::read_dir("/proc").context("cannot list /proc")?;
    let child = |name: &str| {
        let pid = Pid::from_raw(name.parse().ok()?)?;
        let stat = fs::read_to_string(format!("/proc/{name}/stat")).ok()?;
        // The name in parentheses may contain anything; state and parent follow it.
        let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
        let (state, parent) = (fields.next()?, fields.next()?);
        let is_ours = parent == supervisor.as_raw_nonzero().to_string();
        if !is_ours || matches!(state, "Z" | "X") {
            return None;
        }
        let line = fs::read(format!("/proc/{name}/cmdline")).ok()?;
        Some(Member { role: role(&words_after_program(&line))?, pid })
    };
    Ok(entries.flatten().filter_map(|entry| child(entry.file_name().to_str()?)).collect())
}

fn role(words: &[String]) -> Option<Role> {
    let number = |flag| {
        let at = words.iter().position(|word| word == flag)?;
        words.get(at + 1)?.parse::<u64>().ok()
    };
    let small = |flag| u32::try_from(number(flag)?).ok();
    match words.first()?.as_str() {
        "actor" => Some(Role::Worker(small("--index")?, small("--incarnation")?)),
        "learner" => Some(Role::Learner(number("--restarts").unwrap_or(0))),
        "evaluator" => Some(Role::Evaluator),
        _ => None,
    }
}

/// Lists the process ids of a session, except this process. Each [`super::WholeRun`] has its own
/// session.
pub fn of_session(session: Pid) -> anyhow::Result<Vec<String>> {
    let (session, own) = (session.as_raw_nonzero().to_string(), std::process::id().to_string());
    let entries = fs::read_dir("/proc").context("cannot list /proc")?;
    let member = |name: String| {
        let stat = fs::read_to_string(format!("/proc/{name}/stat")).ok()?;
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let (state, its_session) = (*fields.first()?, *fields.get(3)?);
        let lives = !matches!(state, "Z" | "X");
        (lives && its_session == session && name != own).then_some(name)
    };
    let names = entries.flatten().filter_map(|entry| entry.file_name().into_string().ok());
    Ok(names.filter_map(member).collect())
}

/// Reads a process's processor time, including that of ended threads \[s\]; `None` if it is gone.
pub fn cpu_s(pid: Pid) -> Option<f64> {
    let stat = fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero())).ok()?;
    // The name in parentheses may contain anything; utime and stime are the twelfth and thirteenth
    // field after it.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(ticks as f64 / rustix::param::clock_ticks_per_second() as f64)
}

/// Resources of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Holdings {
    /// Memory \[KiB\].
    pub rss_kib: u64,
    /// Open files.
    pub fds: u64,
    /// Memory maps.
    pub maps: u64,
}

/// Reads a process's resources; `None` if it is gone.
pub fn holdings(pid: Pid) -> Option<Holdings> {
    let folder = format!("/proc/{}", pid.as_raw_nonzero());
    let status = fs::read_to_string(format!("{folder}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let rss_kib = line.split_whitespace().next()?.parse().ok()?;
    let fds = fs::read_dir(format!("{folder}/fd")).ok()?.count() as u64;
    let maps = fs::read_to_string(format!("{folder}/maps")).ok()?.lines().count() as u64;
    Some(Holdings { rss_kib, fds, maps })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roles_are_read_from_the_launchers_command_lines() {
        let read = |line: &str| role(&words_after_program(line.replace(' ', "\0").as_bytes()));
        let worker = "dmprl actor --index 1 --incarnation 65538 --run /r --venv /v";
        assert_eq!(read(worker), Some(Role::Worker(1, 65_538)));
        assert_eq!(read("dmprl learner --run /r --domain /d"), Some(Role::Learner(0)));
        let learner = "dmprl learner --run /r --resume --restarts 7";
        assert_eq!(read(learner), Some(Role::Learner(7)));
        assert_eq!(read("dmprl evaluator --run /r"), Some(Role::Evaluator));
        assert_eq!(read("/v/bin/python /v/bin/dmprl evaluator --run /r"), Some(Role::Evaluator));
        assert_eq!(read("dmprl train reacher"), None);
        assert_eq!(read(""), None);
    }

    #[test]
    fn this_process_has_resources() {
        let held = holdings(rustix::process::getpid()).unwrap();
        assert!(held.rss_kib > 0 && held.fds > 2 && held.maps > 2, "{held:?}");
    }

    #[test]
    fn processor_time_is_counted_in_seconds() {
        let clock = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        let read = cpu_s(rustix::process::getpid()).unwrap();
        // The clock was read first, and /proc rounds down to hundredths of a second.
        assert!(read >= clock.tv_sec as f64 - 1.0 && read < clock.tv_sec as f64 + 60.0, "{read}");
    }
}
