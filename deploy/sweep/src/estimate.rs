//! Estimates the remaining time of a sweep from the runs so far.

use std::collections::BTreeMap;
use std::time::Duration;

use dmprl_run::sweep_files::{PlannedRun, Study};

/// Task and method of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RunKind<'a> {
    task: &'a str,
    method: &'a str,
}

impl<'a> RunKind<'a> {
    pub(crate) fn of_run(run: &'a PlannedRun) -> Self {
        Self { task: &run.task, method: &run.method }
    }

    /// Returns the kind of a study's runs.
    pub(crate) fn of_study(study: &'a Study) -> Self {
        Self { task: &study.task, method: &study.method }
    }
}

/// Environment steps and seconds of the runs measured so far, by task and method.
///
/// Runs with the same task and method have a similar cost per step; between others it differs up to
/// tenfold.
#[derive(Debug, Clone, Default)]
pub(crate) struct Estimate {
    measured: BTreeMap<(String, String), Cost>,
}

/// Measured steps and their duration.
#[derive(Debug, Clone, Copy, Default)]
struct Cost {
    env_steps: u64,
    seconds: f64,
}

impl Estimate {
    /// Adds a measurement: steps of a run and their duration.
    pub(crate) fn add(&mut self, kind: RunKind<'_>, env_steps: u64, seconds: f64) {
        let key = (kind.task.to_owned(), kind.method.to_owned());
        let cost = self.measured.entry(key).or_default();
        cost.env_steps += env_steps;
        cost.seconds += seconds;
    }

    /// Returns the seconds per step, averaged over the most similar runs measured: those with the
    /// same task and method, else with the same method, else with the same task, else all.
    fn seconds_per_step(&self, kind: RunKind<'_>) -> Option<f64> {
        let average = |matches: &dyn Fn(RunKind<'_>) -> bool| {
            let matching = self
                .measured
                .iter()
                .filter(|((task, method), _)| matches(RunKind { task, method }))
                .map(|(_, cost)| cost);
            let sum = matching.fold(Cost::default(), |sum, cost| Cost {
                env_steps: sum.env_steps + cost.env_steps,
                seconds: sum.seconds + cost.seconds,
            });
            (sum.env_steps > 0).then(|| sum.seconds / sum.env_steps as f64)
        };
        average(&|other| other == kind)
            .or_else(|| average(&|other| other.method == kind.method))
            .or_else(|| average(&|other| other.task == kind.task))
            .or_else(|| average(&|_| true))
    }

    /// Returns the time in which `jobs` parallel jobs finish all runs in `left`; `None` before the
    /// first measurement.
    ///
    /// - `left`: kind and remaining environment steps of each run.
    pub(crate) fn remaining<'a>(
        &self,
        left: impl IntoIterator<Item = (RunKind<'a>, u64)>,
        jobs: usize,
    ) -> Option<Duration> {
        let mut seconds = Vec::new();
        for (kind, env_steps) in left {
            seconds.push(env_steps as f64 * self.seconds_per_step(kind)?);
        }
        // At least an even share of all work, and at least the longest run.
        let longest = seconds.iter().copied().fold(0.0, f64::max);
        let even = seconds.iter().sum::<f64>() / jobs.max(1) as f64;
        Duration::try_from_secs_f64(longest.max(even)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(task: &'static str, method: &'static str) -> RunKind<'static> {
        RunKind { task, method }
    }

    #[test]
    fn time_per_step_comes_from_the_most_similar_runs() {
        let mut estimate = Estimate::default();
        assert_eq!(estimate.remaining([(kind("reacher", "td3"), 10)], 1), None);
        estimate.add(kind("reacher", "td3"), 100, 10.0);
        estimate.add(kind("pusher", "ndp"), 100, 1.0);
        let seconds = |left: &[(RunKind<'static>, u64)], jobs| {
            let remaining = estimate.remaining(left.iter().copied(), jobs).unwrap();
            (remaining.as_secs_f64() * 1e3).round() / 1e3
        };
        assert_eq!(seconds(&[(kind("reacher", "td3"), 50)], 1), 5.0);
        assert_eq!(seconds(&[(kind("pusher", "td3"), 50)], 1), 5.0, "same method");
        assert_eq!(seconds(&[(kind("pusher", "sac"), 50)], 1), 0.5, "same task");
        assert_eq!(seconds(&[(kind("thrower", "sac"), 200)], 1), 11.0, "all runs");
        let four = [(kind("reacher", "td3"), 50); 4];
        assert_eq!(seconds(&four, 2), 10.0);
        assert_eq!(seconds(&four[..1], 2), 5.0, "a second job does not speed up a single run");
        assert_eq!(seconds(&[], 2), 0.0);
    }
}
