//! Workers that live and give no sign of it: stopped, or standing still where nothing looks.
//!
//! Any report is a sign of life, and each second there is one, also of a worker that waits for its
//! learner or whose environment is slow (`roles/heartbeat.rs`). So silence means a worker that
//! will not go on by itself. It counts only once everything has been heard that there was to hear,
//! and begins anew when the supervisor itself stood still.

use std::time::{Duration, Instant};

use super::Process;
use super::deaths::Death;
use super::supervisor::{Phase, Supervisor};
use crate::control::Report;

impl Supervisor<'_> {
    /// Notes a sign of life.
    pub(super) fn heard(&mut self, process: Process, report: &Report) {
        let slot = self.slots.get_mut(&process);
        if let Some(running) = slot.and_then(|slot| slot.running.as_mut()) {
            running.heard = Instant::now();
            if let Report::Alive { doing, kept } = report {
                running.doing = Some(*doing);
                running.kept = *kept;
            }
        }
    }

    /// Forgets how long everybody has been silent.
    pub(super) fn hear_anew(&mut self, now: Instant) {
        for running in self.slots.values_mut().filter_map(|slot| slot.running.as_mut()) {
            running.heard = now;
        }
    }

    /// Who of workers, gateway and relay will first have been silent for too long, and when. One
    /// that is not ready has another limit.
    pub(super) fn first_silent(&self) -> Option<(Instant, Process)> {
        if self.phase != Phase::Training {
            return None;
        }
        // A limit beyond what a clock can hold is none.
        let limit =
            Duration::try_from_secs_f64(self.config.supervision.heartbeat_timeout_s).ok()?;
        let workers = self.all_running().filter(|(process, running)| {
            let speaks = !matches!(process, Process::Learner | Process::Evaluator);
            speaks && running.ready && running.killed_for.is_none()
        });
        workers
            .filter_map(|(process, running)| Some((running.heard.checked_add(limit)?, process)))
            .min()
    }

    /// Kills workers that have been silent for too long; their exits follow.
    pub(super) fn check_heartbeats(&mut self, now: Instant) {
        while let Some((_, process)) = self.first_silent().filter(|(at, _)| now >= *at) {
            let slot = self.slots.get_mut(&process);
            let Some(running) = slot.and_then(|slot| slot.running.as_mut()) else { return };
            let cause = format!(
                "no sign of life for {:.1} s, supervision.heartbeat_timeout_s = {}; the last: {}",
                now.duration_since(running.heard).as_secs_f64(),
                self.config.supervision.heartbeat_timeout_s,
                running.doing.map_or("it was ready", |doing| doing.name())
            );
            running.kill_for(Death::hung(cause));
        }
    }
}
