//! Kills processes that are silent for too long.

use std::time::{Duration, Instant};

use dmprl_control::Activity;

use super::machine::Machine;
use super::process::Process;
use super::restart_policy::Death;
use super::state::Phase;

/// Limit of a process's silence.
struct SilenceLimit {
    /// Its configuration key.
    key: &'static str,
    /// Its value \[s\].
    seconds: f64,
}

impl Machine {
    /// Returns the limit of a process's silence; `None` if it may be silent.
    ///
    /// An evaluator has a limit for each evaluation instead. The learner of a one-process run also
    /// evaluates, and cannot be replaced.
    fn silence_limit(&self, process: Process) -> Option<SilenceLimit> {
        let supervision = &self.settings.config.supervision;
        match process {
            Process::Evaluator => None,
            Process::Learner if self.settings.one_process => None,
            Process::Learner => Some(SilenceLimit {
                key: "supervision.learner_timeout_s",
                seconds: supervision.learner_timeout_s,
            }),
            _ => Some(SilenceLimit {
                key: "supervision.heartbeat_timeout_s",
                seconds: supervision.heartbeat_timeout_s,
            }),
        }
    }

    /// Returns the process whose silence will first exceed its limit, and when.
    pub(super) fn first_silent(&self) -> Option<(Instant, Process)> {
        if self.phase != Phase::Training {
            return None;
        }
        self.children.first_silent(|process| {
            // A limit beyond the range of a clock means no limit.
            Duration::try_from_secs_f64(self.silence_limit(process)?.seconds).ok()
        })
    }

    /// Kills processes whose heartbeats are missing. Workers, gateway and relay send one every
    /// second, even while they wait for the learner or an environment is slow (`heartbeat.rs` in
    /// `dmprl-control`). The learner's loop reports its progress twice a second.
    pub(super) fn check_heartbeats(&mut self) {
        while let Some((_, process)) = self.first_silent().filter(|(at, _)| self.now >= *at) {
            let Some(running) = self.children.running(process) else { return };
            let Some(SilenceLimit { key, seconds }) = self.silence_limit(process) else { return };
            let cause = format!(
                "no heartbeat for {:.1} s, {key} = {seconds}; last activity: {}",
                self.now.duration_since(running.heard).as_secs_f64(),
                running.activity.map_or("ready", Activity::name)
            );
            self.kill(process, Death::hung(cause));
        }
    }
}
