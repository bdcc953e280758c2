//! The report of a trial, as JSON and as text.

use serde_json::{Value, json};

use super::checker::SegmentTotals;
use super::fault_injector::FaultCounts;
use super::samples::{Samples, median};

/// Result of a trial.
pub struct Report {
    pub(super) seed: u64,
    pub(super) workers: u32,
    /// Duration of the fault injection [s].
    pub(super) seconds: f64,
    pub(super) interrupted: bool,
    pub(super) faults: FaultCounts,
    pub(super) violations: Vec<String>,
    pub(super) sums: SegmentTotals,
    pub(super) env_steps: u64,
    pub(super) checkpoints: u64,
    pub(super) worker_back_s: Vec<f64>,
    pub(super) learner_back_s: Vec<f64>,
    /// Segments of each worker while no fault was active, and the length of that time [s].
    pub(super) undisturbed: Vec<u64>,
    pub(super) undisturbed_s: f64,
    pub(super) samples: Samples,
    /// Path of the kept files, if any.
    pub(super) kept: Option<String>,
}

impl Report {
    /// Returns true if there was no violation.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.violations.is_empty()
    }

    /// Returns true if the user interrupted the trial.
    #[must_use]
    pub fn is_interrupted(&self) -> bool {
        self.interrupted
    }

    /// Returns the largest number of segments of a worker divided by the smallest, counted while no
    /// fault was active.
    fn fairness(&self) -> Option<f64> {
        let (most, fewest) = (self.undisturbed.iter().max()?, self.undisturbed.iter().min()?);
        (*fewest > 0).then(|| *most as f64 / *fewest as f64)
    }

    /// Returns the report as one JSON object.
    #[must_use]
    pub fn json(&self) -> Value {
        let SegmentTotals {
            produced,
            inserted,
            rejected,
            in_flight,
            lost,
            duplicate,
            acknowledged,
        } = self.sums;
        let faults = &self.faults;
        let mut object = json!({
            "seed": self.seed,
            "workers": self.workers,
            "seconds": self.seconds,
            "interrupted": self.interrupted,
            "violations": self.violations,
            "worker_kills": faults.worker_kills,
            "learner_kills": faults.learner_kills,
            "learner_kills_in_recovery": faults.learner_kills_in_recovery,
            "learner_kills_in_checkpoint": faults.learner_kills_in_checkpoint,
            "evaluator_kills": faults.evaluator_kills,
            "stops": faults.stops,
            "strikes_left_out": faults.skipped,
            "produced": produced,
            "inserted": inserted,
            "rejected": rejected,
            "in_flight": in_flight,
            "lost": lost,
            "duplicate": duplicate,
            "acknowledged": acknowledged,
            "env_steps": self.env_steps,
            "checkpoints": self.checkpoints,
            "worker_back_s": recovery_json(&self.worker_back_s),
            "learner_back_s": recovery_json(&self.learner_back_s),
            "fairness": self.fairness(),
            "undisturbed_s": self.undisturbed_s,
            "held": self.samples.summary(),
            "kept": self.kept,
        });
        for (name, ratio) in self.samples.ratios() {
            object[name] = ratio.into();
        }
        object
    }

    /// Returns the report as text.
    #[must_use]
    pub fn text(&self) -> String {
        let SegmentTotals { produced, inserted, rejected, in_flight, lost, duplicate, .. } =
            self.sums;
        let faults = &self.faults;
        let mut lines = vec![
            format!(
                "killed       {} workers, {} learners ({} recovering, {} writing a checkpoint), {} \
                 evaluators; suspended processes {} times",
                faults.worker_kills,
                faults.learner_kills,
                faults.learner_kills_in_recovery,
                faults.learner_kills_in_checkpoint,
                faults.evaluator_kills,
                faults.stops
            ),
            format!(
                "segments     {produced} produced = {inserted} inserted + {rejected} rejected + \
                 {in_flight} in flight + {lost} lost; {duplicate} duplicates rejected"
            ),
            format!("worker back  {}", recovery_text(&self.worker_back_s)),
            format!("learner back {}", recovery_text(&self.learner_back_s)),
            format!(
                "fairness     {} between {} workers, in {:.0} s without faults",
                number(self.fairness()),
                self.workers,
                self.undisturbed_s
            ),
        ];
        let growth = self.samples.ratios();
        let growth: Vec<_> =
            growth.iter().map(|(name, ratio)| format!("{name} {}", number(*ratio))).collect();
        lines.push(format!("growth       {}", growth.join(", ")));
        match self.violations.len() {
            0 => lines
                .push(format!("violations   none in {:.0} s, seed {}", self.seconds, self.seed)),
            count => {
                lines.push(format!("violations   {count}, seed {}:", self.seed));
                lines.extend(self.violations.iter().map(|violation| format!("  {violation}")));
            }
        }
        lines.extend(self.kept.iter().map(|path| format!("kept         {path}")));
        lines.join("\n")
    }
}

fn recovery_json(seconds: &[f64]) -> Value {
    let max = seconds.iter().copied().reduce(f64::max);
    json!({ "count": seconds.len(), "p50": median(seconds), "max": max })
}

fn recovery_text(seconds: &[f64]) -> String {
    let max = seconds.iter().copied().reduce(f64::max);
    let (count, p50) = (seconds.len(), number(median(seconds)));
    format!("after {p50} s (median of {count}), at most {} s", number(max))
}

fn number(number: Option<f64>) -> String {
    number.map_or_else(|| "—".to_owned(), |number| format!("{number:.2}"))
}
