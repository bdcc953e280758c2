//! The window of a run that is measured, between two lines of its metrics.

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_learner::metrics::MetricsLine;
use rustix::process::Pid;

use super::SystemBench;
use crate::bench::watch::Watch;
use crate::dashboard::tail::Tail;
use crate::launch::WholeRun;
use crate::launch::members::{Role, cpu_s, members};

/// Without a new line for so long the run makes no progress: a start reads Python's packages.
const SILENCE: Duration = Duration::from_secs(300);
/// After the first update: buffers have their size, caches and clock frequency are a long run's.
const SETTLE_S: f64 = 1.0;
/// Between two looks at the file.
const LOOK: Duration = Duration::from_millis(5);

/// Processor time so far [s].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(in crate::bench) struct CpuTime {
    pub(in crate::bench) learner_s: f64,
    /// All of them together.
    pub(in crate::bench) workers_s: f64,
    /// Supervisor and evaluator.
    pub(in crate::bench) others_s: f64,
}

impl CpuTime {
    fn of(supervisor: Pid) -> anyhow::Result<Self> {
        let mut time = Self { others_s: cpu_s(supervisor).unwrap_or(0.0), ..Self::default() };
        for member in members(supervisor)? {
            // One that has just ended has none.
            let seconds = cpu_s(member.pid()).unwrap_or(0.0);
            match member.role {
                Role::Learner(_) => time.learner_s += seconds,
                Role::Worker(..) => time.workers_s += seconds,
                Role::Evaluator => time.others_s += seconds,
            }
        }
        Ok(time)
    }

    fn since(self, before: Self) -> Self {
        Self {
            learner_s: self.learner_s - before.learner_s,
            workers_s: self.workers_s - before.workers_s,
            others_s: self.others_s - before.others_s,
        }
    }
}

/// What was measured.
#[derive(Debug, Clone)]
pub(in crate::bench) struct Window {
    /// The line that opens it: what came before is left out.
    pub(in crate::bench) first: MetricsLine,
    /// The line that closes it.
    pub(in crate::bench) last: MetricsLine,
    /// Policy lag of the lines within: each one's median, each one's largest.
    pub(in crate::bench) lags: Vec<(u64, u64)>,
    /// Between the moments in which the two lines were seen,
    pub(in crate::bench) cpu: CpuTime,
    /// which lie so far apart [s].
    pub(in crate::bench) seen_s: f64,
}

impl Window {
    /// Its length by the learner's clock [s].
    pub(in crate::bench) fn wall_s(&self) -> f64 {
        self.last.wall_s - self.first.wall_s
    }

    /// A count's growth per second.
    pub(in crate::bench) fn per_s(&self, count: impl Fn(&MetricsLine) -> u64) -> f64 {
        count(&self.last).saturating_sub(count(&self.first)) as f64 / self.wall_s()
    }

    /// Samples drawn for each environment step inserted.
    pub(in crate::bench) fn samples_per_insert(&self) -> f64 {
        let samples = |line: &MetricsLine| line.samples_per_insert * line.env_steps as f64;
        let steps = self.last.env_steps.saturating_sub(self.first.env_steps).max(1);
        (samples(&self.last) - samples(&self.first)) / steps as f64
    }
}

/// Follows a run's metrics.
pub(super) struct Steady {
    tail: Tail,
    supervisor: Pid,
    workers: u64,
    warm_up_steps: u64,
    duration_s: f64,
    settled_from: Option<f64>,
    open: Option<Open>,
}

/// The window before it is closed.
struct Open {
    first: MetricsLine,
    lags: Vec<(u64, u64)>,
    cpu: CpuTime,
    seen: Instant,
}

impl Steady {
    pub(super) fn new(metrics: &Path, supervisor: Pid, bench: &SystemBench) -> Self {
        Self {
            tail: Tail::new(metrics),
            supervisor,
            workers: bench.config.actors.workers as u64,
            warm_up_steps: bench.config.exploration.warm_up_steps,
            duration_s: bench.duration.as_secs_f64(),
            settled_from: None,
            open: None,
        }
    }

    pub(super) fn until_measured(
        mut self,
        train: &mut WholeRun,
        watch: &Watch,
        told: &dyn Fn(&str),
    ) -> anyhow::Result<Window> {
        let mut heard = Instant::now();
        loop {
            watch.check()?;
            let look = self.tail.look()?;
            for line in look.lines.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
                heard = Instant::now();
                let line = serde_json::from_slice(line).context("a damaged line of metrics")?;
                if let Some(window) = self.take(line, told)? {
                    return Ok(window);
                }
            }
            if let Some(how) = train.end()? {
                bail!("dmprl train has ended by itself: {how}");
            }
            if heard.elapsed() >= SILENCE {
                bail!("the run wrote no metrics for {SILENCE:?}");
            }
            thread::sleep(LOOK);
        }
    }

    /// The window, if this line closes it.
    fn take(&mut self, line: MetricsLine, told: &dyn Fn(&str)) -> anyhow::Result<Option<Window>> {
        let Some(open) = &mut self.open else {
            let learns = line.updates > 0 && line.env_steps > self.warm_up_steps;
            if learns && line.workers >= self.workers {
                let from = *self.settled_from.get_or_insert_with(|| {
                    told("the warm-up is over");
                    line.wall_s
                });
                if line.wall_s >= from + SETTLE_S {
                    told(&format!("measuring for {} s", self.duration_s));
                    let cpu = CpuTime::of(self.supervisor)?;
                    let seen = Instant::now();
                    self.open = Some(Open { first: line, lags: Vec::new(), cpu, seen });
                }
            }
            return Ok(None);
        };
        open.lags.extend(line.policy_lag_p50.zip(line.policy_lag_max));
        if line.wall_s < open.first.wall_s + self.duration_s {
            return Ok(None);
        }
        let cpu = CpuTime::of(self.supervisor)?.since(open.cpu);
        let seen_s = open.seen.elapsed().as_secs_f64();
        let (first, lags) = (open.first.clone(), std::mem::take(&mut open.lags));
        Ok(Some(Window { first, last: line, lags, cpu, seen_s }))
    }
}
