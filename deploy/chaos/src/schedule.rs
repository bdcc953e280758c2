//! Generates a schedule of faults, with times and victims, from a seed.

use std::ops::RangeInclusive;

use dmprl_shared::seeds::{self, Stream};
use rand::RngExt;
use rand::seq::SliceRandom;

/// Range of the pause before a fault [ms].
const PAUSE_MS: RangeInclusive<u64> = 300..=1_500;
/// Range of the time for which a process is suspended [ms].
const SUSPENSION_MS: RangeInclusive<u64> = 200..=2_000;
/// Range of the delay after which a newly started learner is killed again [ms].
const KILL_AGAIN_MS: RangeInclusive<u64> = 0..=600;
/// Time without faults, in which the workers' fairness is measured [ms].
const REST_MS: u64 = 4_000;

/// A fault to inject.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// SIGKILL to a worker.
    KillWorker {
        /// Index of the worker.
        worker: u32,
        /// True if the worker may still be starting.
        early: bool,
    },
    /// SIGKILL to all workers at once.
    KillWorkers,
    /// SIGKILL to the learner.
    KillLearner,
    /// SIGKILL to the learner, and to its successor while that starts.
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
    /// A time without faults.
    Rest {
        /// Duration after the recovery from the last fault.
        for_ms: u64,
    },
}

impl Fault {
    /// Returns true if the fault kills or suspends the learner.
    pub(super) fn targets_learner(self) -> bool {
        matches!(
            self,
            Self::KillLearner
                | Self::KillLearnerTwice { .. }
                | Self::KillLearnerInCheckpoint
                | Self::StopLearner { .. }
        )
    }
}

/// A fault and the pause before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ScheduledFault {
    pub(super) pause_ms: u64,
    pub(super) fault: Fault,
}

/// Endless sequence of faults, in rounds that contain every kind of fault in random order.
#[derive(Debug)]
pub(super) struct Schedule {
    random: Stream,
    workers: u32,
    /// The remaining faults of the current round.
    round: Vec<FaultKind>,
}

#[derive(Debug, Clone, Copy)]
enum FaultKind {
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

/// Kinds of faults in a round and how often each occurs. About ten workers are killed per learner.
const ROUND: [(FaultKind, usize); 10] = [
    (FaultKind::Worker { early: false }, 22),
    (FaultKind::Worker { early: true }, 8),
    (FaultKind::Workers, 3),
    (FaultKind::Learner, 1),
    (FaultKind::LearnerTwice, 1),
    (FaultKind::InCheckpoint, 1),
    (FaultKind::StopWorker, 2),
    (FaultKind::StopLearner, 1),
    (FaultKind::Evaluator, 1),
    (FaultKind::Rest, 1),
];

impl Schedule {
    pub(super) fn new(seed: u64, workers: u32) -> Self {
        Self { random: seeds::stream(seed, "chaos", 0), workers, round: Vec::new() }
    }

    fn kind(&mut self) -> FaultKind {
        if self.round.is_empty() {
            for (kind, count) in ROUND {
                self.round.extend(std::iter::repeat_n(kind, count));
            }
            self.round.shuffle(&mut self.random);
        }
        self.round.pop().unwrap_or(FaultKind::Learner)
    }

    fn draw(&mut self, range: RangeInclusive<u64>) -> u64 {
        self.random.random_range(range)
    }
}

impl Iterator for Schedule {
    type Item = ScheduledFault;

    fn next(&mut self) -> Option<ScheduledFault> {
        let kind = self.kind();
        // Always draws the same number of values, so that all kinds advance the stream equally.
        let (pause_ms, worker) = (self.draw(PAUSE_MS), self.random.random_range(0..self.workers));
        let (for_ms, after_ms) = (self.draw(SUSPENSION_MS), self.draw(KILL_AGAIN_MS));
        let fault = match kind {
            FaultKind::Worker { early } => Fault::KillWorker { worker, early },
            FaultKind::Workers => Fault::KillWorkers,
            FaultKind::Learner => Fault::KillLearner,
            FaultKind::LearnerTwice => Fault::KillLearnerTwice { after_ms },
            FaultKind::InCheckpoint => Fault::KillLearnerInCheckpoint,
            FaultKind::StopWorker => Fault::StopWorker { worker, for_ms },
            FaultKind::StopLearner => Fault::StopLearner { for_ms },
            FaultKind::Evaluator => Fault::KillEvaluator,
            FaultKind::Rest => Fault::Rest { for_ms: REST_MS },
        };
        Some(ScheduledFault { pause_ms, fault })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schedule_depends_only_on_the_seed() {
        let schedule = |seed| Schedule::new(seed, 3).take(100).collect::<Vec<_>>();
        assert_eq!(schedule(1), schedule(1));
        assert_ne!(schedule(1), schedule(2));
    }

    #[test]
    fn every_round_has_faults_of_every_process() {
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
