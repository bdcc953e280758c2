//! Counts of events over one simulated session or many.

use std::collections::BTreeMap;

/// Counts of events, by name.
#[derive(Debug, Default)]
pub struct Tally(BTreeMap<&'static str, u64>);

/// Names of events that must occur in some session.
const EXPECTED: [&str; 28] = [
    "abandoned",
    "answers",
    "completed",
    "deaths of evaluators",
    "deaths of gateways",
    "deaths of learners",
    "deaths of workers",
    "domain lost",
    "drained",
    "environment failures",
    "evaluations failed",
    "evaluations given up with a learner",
    "evaluations given up with the run",
    "evaluations repeated",
    "failed",
    "failures while stopping",
    "hangs",
    "hangs of learners",
    "hosts without a learner",
    "interrupted",
    "joined",
    "kills",
    "late answers",
    "left",
    "lock lost",
    "one process",
    "refused",
    "workers given up",
];

impl Tally {
    pub fn count(&mut self, name: &'static str) {
        *self.0.entry(name).or_default() += 1;
    }

    pub fn add(&mut self, more: &Self) {
        for (name, count) in &more.0 {
            *self.0.entry(name).or_default() += count;
        }
    }

    /// Returns the expected names that did not occur.
    pub fn missing(&self) -> Vec<&'static str> {
        EXPECTED.into_iter().filter(|name| !self.0.contains_key(name)).collect()
    }
}
