//! Generates a schedule of faults, times and victims from a seed.

use dmprl_shared::seeds::{self, Stream};
use rand::RngExt;
use rand::seq::SliceRandom;

/// Minimum and maximum pause between two strikes [ms].
const PAUSE_MS: (u64, u64) = (300, 1_500);
/// Minimum and maximum time for which a process is suspended [ms].
const STOP_MS: (u64, u64) = (200, 2_000);
/// Minimum and maximum delay after which a newly started learner is killed again [ms].
const AGAIN_MS: (u64, u64) = (0, 600);
/// Time without faults, in which undisturbed work is measured [ms].
const REST_MS: u64 = 4_000;

/// A fault to inject.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// SIGKILL to a worker.
    KillWorker {
        /// Index of the worker.
        worker: u32,
        /// True if it may still be starting.
        early: bool,
    },
    /// SIGKILL to all workers at once.
    KillWorkers,
    /// SIGKILL to the learner.
    KillLearner,
    /// SIGKILL to the learner, and again while its successor starts.
    KillLearnerTwice {
        /// Delay after the successor's start.
        after_ms: u64,
    },
    /// SIGKILL to the learner while it writes a checkpoint.
    KillLearnerInCheckpoint,
    /// SIGSTOP to a worker, then SIGCONT.
    StopWorker {
        /// Index of the worker.
        worker: u32,
        /// Time between the two signals.
        for_ms: u64,
    },
    /// SIGSTOP to the learner, then SIGCONT.
    StopLearner {
        /// Time between the two signals.
        for_ms: u64,
    },
    /// SIGKILL to the evaluator.
    KillEvaluator,
    /// No fault.
    Rest {
        /// Duration after the recovery from the last fault.
        for_ms: u64,
    },
}

/// A fault and the pause before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Strike {
    pub(super) pause_ms: u64,
    pub(super) fault: Fault,
}

/// Endless sequence of strikes, in rounds that contain every kind of fault in random order.
#[derive(Debug)]
pub(super) struct Schedule {
    random: Stream,
    workers: u32,
    /// The remaining faults of the current round.
    round: Vec<Kind>,
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Worker { early: bool },
    Workers,
    Learner,
    LearnerTwice,
    InCheckpoint,
    StopWorker,
    StopLearner,
    Evaluator,
    Rest,
}

/// Faults of a round: about ten workers are killed for each learner.
const ROUND: [(Kind, usize); 10] = [
    (Kind::Worker { early: false }, 22),
    (Kind::Worker { early: true }, 8),
    (Kind::Workers, 3),
    (Kind::Learner, 1),
    (Kind::LearnerTwice, 1),
    (Kind::InCheckpoint, 1),
    (Kind::StopWorker, 2),
    (Kind::StopLearner, 1),
    (Kind::Evaluator, 1),
    (Kind::Rest, 1),
];

impl Schedule {
    pub(super) fn new(seed: u64, workers: u32) -> Self {
        Self { random: seeds::stream(seed, "chaos", 0), workers, round: Vec::new() }
    }

    fn kind(&mut self) -> Kind {
        if self.round.is_empty() {
            for (kind, count) in ROUND {
                self.round.extend(std::iter::repeat_n(kind, count));
            }
            self.round.shuffle(&mut self.random);
        }
        self.round.pop().unwrap_or(Kind::Learner)
    }

    fn between(&mut self, (least, most): (u64, u64)) -> u64 {
        self.random.random_range(least..=most)
    }
}

impl Iterator for Schedule {
    type Item = Strike;

    fn next(&mut self) -> Option<Strike> {
        let kind = self.kind();
        // Always draws the same number of values, whether or not the fault needs them.
        let (pause_ms, worker) =
            (self.between(PAUSE_MS), self.random.random_range(0..self.workers));
        let (stop_ms, after_ms) = (self.between(STOP_MS), self.between(AGAIN_MS));
        let fault = match kind {
            Kind::Worker { early } => Fault::KillWorker { worker, early },
            Kind::Workers => Fault::KillWorkers,
            Kind::Learner => Fault::KillLearner,
            Kind::LearnerTwice => Fault::KillLearnerTwice { after_ms },
            Kind::InCheckpoint => Fault::KillLearnerInCheckpoint,
            Kind::StopWorker => Fault::StopWorker { worker, for_ms: stop_ms },
            Kind::StopLearner => Fault::StopLearner { for_ms: stop_ms },
            Kind::Evaluator => Fault::KillEvaluator,
            Kind::Rest => Fault::Rest { for_ms: REST_MS },
        };
        Some(Strike { pause_ms, fault })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_is_a_schedule_and_another_seed_another() {
        let strikes = |seed| Schedule::new(seed, 3).take(100).collect::<Vec<_>>();
        assert_eq!(strikes(1), strikes(1));
        assert_ne!(strikes(1), strikes(2));
    }

    #[test]
    fn every_round_strikes_everybody() {
        let len = ROUND.iter().map(|(_, count)| count).sum();
        for seed in 0..20 {
            let round: Vec<_> = Schedule::new(seed, 2).take(len).map(|it| it.fault).collect();
            let any = |matches: fn(&Fault) -> bool| round.iter().any(matches);
            assert!(any(|fault| matches!(fault, Fault::KillWorker { worker: 0, .. })));
            assert!(any(|fault| matches!(fault, Fault::KillWorker { worker: 1, .. })));
            assert!(any(|fault| matches!(fault, Fault::KillWorkers)));
            assert!(any(|fault| matches!(fault, Fault::KillLearnerTwice { .. })));
            assert!(any(|fault| matches!(fault, Fault::KillLearnerInCheckpoint)));
            assert!(any(|fault| matches!(fault, Fault::StopLearner { .. })));
            assert!(any(|fault| matches!(fault, Fault::KillEvaluator)));
        }
    }
}
