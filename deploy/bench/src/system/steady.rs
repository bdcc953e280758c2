//! Measures a run between two lines of its metrics.

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use dmprl_learner::metrics::MetricsLine;
use dmprl_run::Watch;
use dmprl_run::tail::Tail;
use dmprl_supervisor::WholeRun;
use dmprl_supervisor::members::{Role, cpu_s, members};
use rustix::process::Pid;

use super::SystemBench;

/// Time without a new line after which the run counts as stuck. Start-up includes importing Python
/// packages.
const SILENCE: Duration = Duration::from_secs(300);
/// Time after the warm-up for buffers, caches and clock frequency to reach a steady state.
const SETTLE_S: f64 = 1.0;
/// Interval between checks for new lines.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// Processor time so far [s].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct CpuTime {
    pub(crate) learner_s: f64,
    /// All workers together.
    pub(crate) workers_s: f64,
    /// Supervisor and evaluator.
    pub(crate) others_s: f64,
}

impl CpuTime {
    fn of(supervisor: Pid) -> anyhow::Result<Self> {
        let mut time = Self { others_s: cpu_s(supervisor).unwrap_or(0.0), ..Self::default() };
        for member in members(supervisor)? {
            // `None` if the process has just exited.
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

/// The steady state of a run, between two lines of its metrics.
#[derive(Debug, Clone)]
pub(crate) struct SteadyWindow {
    /// Line at the start of the measurement.
    pub(crate) first: MetricsLine,
    /// Line at the end of the measurement.
    pub(crate) last: MetricsLine,
    /// Median and maximum of the policy lag, for each line after the first.
    pub(crate) lags: Vec<(u64, u64)>,
    /// Processor time between the readings of the two lines.
    pub(crate) cpu: CpuTime,
    /// Time between these readings [s].
    pub(crate) seen_s: f64,
}

impl SteadyWindow {
    /// Duration by the learner's clock [s].
    pub(crate) fn wall_s(&self) -> f64 {
        self.last.wall_s - self.first.wall_s
    }

    /// Returns the increase of a counter per second.
    pub(crate) fn per_s(&self, count: impl Fn(&MetricsLine) -> u64) -> f64 {
        count(&self.last).saturating_sub(count(&self.first)) as f64 / self.wall_s()
    }

    /// Returns the number of samples drawn per environment step inserted.
    pub(crate) fn samples_per_insert(&self) -> f64 {
        let samples = |line: &MetricsLine| line.samples_per_insert * line.env_steps as f64;
        let steps = self.last.env_steps.saturating_sub(self.first.env_steps).max(1);
        (samples(&self.last) - samples(&self.first)) / steps as f64
    }
}

/// Follows the metrics of a run.
pub(super) struct MetricsMonitor {
    tail: Tail,
    supervisor: Pid,
    workers: u64,
    warm_up_steps: u64,
    duration_s: f64,
    settled_from: Option<f64>,
    measuring: Option<Measuring>,
}

/// A measurement in progress.
struct Measuring {
    first: MetricsLine,
    lags: Vec<(u64, u64)>,
    cpu: CpuTime,
    seen: Instant,
}

impl MetricsMonitor {
    pub(super) fn new(metrics: &Path, supervisor: Pid, bench: &SystemBench) -> Self {
        Self {
            tail: Tail::new(metrics),
            supervisor,
            workers: bench.config.actors.workers as u64,
            warm_up_steps: bench.config.exploration.warm_up_steps,
            duration_s: bench.duration.as_secs_f64(),
            settled_from: None,
            measuring: None,
        }
    }

    /// Waits for the end of the measurement, and returns its result.
    pub(super) fn until_measured(
        mut self,
        train: &mut WholeRun,
        watch: &Watch,
        report: &dyn Fn(&str),
    ) -> anyhow::Result<SteadyWindow> {
        let mut last_line = Instant::now();
        loop {
            watch.check()?;
            let look = self.tail.look()?;
            for line in look.lines.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
                last_line = Instant::now();
                let line = serde_json::from_slice(line).context("invalid line of metrics")?;
                if let Some(window) = self.process(line, report)? {
                    return Ok(window);
                }
            }
            if let Some(how) = train.end()? {
                bail!("dmprl train exited unexpectedly: {how}");
            }
            if last_line.elapsed() >= SILENCE {
                bail!("the run wrote no metrics for {SILENCE:?}");
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Processes a line. Returns the result if the line ends the measurement.
    fn process(
        &mut self,
        line: MetricsLine,
        report: &dyn Fn(&str),
    ) -> anyhow::Result<Option<SteadyWindow>> {
        let Some(measuring) = &mut self.measuring else {
            let learns = line.updates > 0 && line.env_steps > self.warm_up_steps;
            if learns && line.workers >= self.workers {
                let from = *self.settled_from.get_or_insert_with(|| {
                    report("the warm-up is over");
                    line.wall_s
                });
                if line.wall_s >= from + SETTLE_S {
                    report(&format!("measuring for {} s", self.duration_s));
                    let cpu = CpuTime::of(self.supervisor)?;
                    let seen = Instant::now();
                    self.measuring = Some(Measuring { first: line, lags: Vec::new(), cpu, seen });
                }
            }
            return Ok(None);
        };
        measuring.lags.extend(line.policy_lag_p50.zip(line.policy_lag_max));
        if line.wall_s < measuring.first.wall_s + self.duration_s {
            return Ok(None);
        }
        let cpu = CpuTime::of(self.supervisor)?.since(measuring.cpu);
        let seen_s = measuring.seen.elapsed().as_secs_f64();
        let (first, lags) = (measuring.first.clone(), std::mem::take(&mut measuring.lags));
        Ok(Some(SteadyWindow { first, last: line, lags, cpu, seen_s }))
    }
}
