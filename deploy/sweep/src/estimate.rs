//! Estimates the remaining time of a sweep from the runs so far.

use std::collections::BTreeMap;
use std::time::Duration;

/// Steps and seconds of the runs measured so far, by task and method: the cost per step is similar
/// for runs of the same kind, but differs tenfold between kinds.
#[derive(Debug, Clone, Default)]
pub(super) struct Estimate {
    measured: BTreeMap<(String, String), Cost>,
}

/// Measured steps and their duration.
#[derive(Debug, Clone, Copy, Default)]
struct Cost {
    env_steps: u64,
    seconds: f64,
}

impl Estimate {
    /// Adds a measurement: the steps of one kind of run and their duration.
    pub(super) fn add(&mut self, kind: (&str, &str), env_steps: u64, seconds: f64) {
        let cost = self.measured.entry((kind.0.to_owned(), kind.1.to_owned())).or_default();
        cost.env_steps += env_steps;
        cost.seconds += seconds;
    }

    /// Seconds per step: of the same task and method if measured, else of the same method, of the
    /// same task, of all runs.
    fn seconds_per_step(&self, (task, method): (&str, &str)) -> Option<f64> {
        let of = |fits: &dyn Fn(&str, &str) -> bool| {
            let kinds = self.measured.iter().filter(|(kind, _)| fits(&kind.0, &kind.1));
            let sum = kinds.fold(Cost::default(), |sum, (_, cost)| Cost {
                env_steps: sum.env_steps + cost.env_steps,
                seconds: sum.seconds + cost.seconds,
            });
            (sum.env_steps > 0).then(|| sum.seconds / sum.env_steps as f64)
        };
        of(&|of_task, of_method| of_task == task && of_method == method)
            .or_else(|| of(&|_, of_method| of_method == method))
            .or_else(|| of(&|of_task, _| of_task == task))
            .or_else(|| of(&|_, _| true))
    }

    /// Time until all runs in `left`, ((task, method), steps) each, are finished by `jobs` parallel
    /// jobs; `None` before the first measurement.
    pub(super) fn remaining<'a>(
        &self,
        left: impl IntoIterator<Item = ((&'a str, &'a str), u64)>,
        jobs: usize,
    ) -> Option<Duration> {
        let mut runs = Vec::new();
        for (kind, env_steps) in left {
            runs.push(env_steps as f64 * self.seconds_per_step(kind)?);
        }
        // At least an even share of all work, and at least the longest run.
        let longest = runs.iter().copied().fold(0.0, f64::max);
        let even = runs.iter().sum::<f64>() / jobs.max(1) as f64;
        Duration::try_from_secs_f64(longest.max(even)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_measured_by_their_own_kind_first() {
        let mut estimate = Estimate::default();
        assert_eq!(estimate.remaining([(("reacher", "td3"), 10)], 1), None);
        estimate.add(("reacher", "td3"), 100, 10.0);
        estimate.add(("pusher", "ndp"), 100, 1.0);
        let seconds = |left: &[((&str, &str), u64)], jobs| {
            let remaining = estimate.remaining(left.iter().copied(), jobs).unwrap();
            (remaining.as_secs_f64() * 1e3).round() / 1e3
        };
        assert_eq!(seconds(&[(("reacher", "td3"), 50)], 1), 5.0);
        assert_eq!(seconds(&[(("pusher", "td3"), 50)], 1), 5.0, "the method's");
        assert_eq!(seconds(&[(("pusher", "sac"), 50)], 1), 0.5, "the task's");
        assert_eq!(seconds(&[(("thrower", "sac"), 200)], 1), 11.0, "of all");
        let four = [(("reacher", "td3"), 50); 4];
        assert_eq!(seconds(&four, 2), 10.0);
        assert_eq!(seconds(&four[..1], 2), 5.0, "one run is no faster for two places");
        assert_eq!(seconds(&[], 2), 0.0);
    }
}
