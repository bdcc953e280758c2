//! The steps of the optimiser and the target networks, to measure their share of an update.

use dmprl_learner::learner::Learner;
use dmprl_learner::update::kernels::{AdamPass, InstructionSet, PolyakStep, StepSizes, adam};
use dmprl_learner::update::network::TrainableNetwork;
use dmprl_learner::update::thread_pool::ThreadPool;

/// Step count: large, so that the bias corrections are those of a long run.
const STEP: u64 = 100_000;
/// Small enough that repeated steps do not change the numbers.
const LEARNING_RATE: f64 = 1e-12;

/// The optimiser steps of a cycle of updates, on networks of their own.
#[derive(Debug)]
pub(super) struct OptimiserSteps {
    pool: ThreadPool,
    /// Each thread's parts of all networks.
    shares: Vec<Vec<NetworkPart>>,
    polyak: f32,
    /// Number of updates in a cycle.
    pub(super) updates: u64,
}

/// One thread's part of a network. Each vector is (P,).
#[derive(Debug)]
struct NetworkPart {
    parameters: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
    target: Vec<f32>,
    gradient: Vec<f32>,
    has_target: bool,
    /// Steps in a cycle: one for an actor, one per update for a critic.
    steps: u64,
}

impl OptimiserSteps {
    /// Allocates networks of the same sizes as the learner's. `updates` is the number of updates in
    /// a cycle.
    pub(super) fn new(learner: &Learner, updates: u64) -> Self {
        let config = learner.config();
        let (threads, polyak) = (config.learner.threads, config.algorithm.polyak as f32);
        let share = |index: usize| {
            let part = |(name, network): (&str, &TrainableNetwork)| {
                let all = network.gradient().len();
                let len = all * (index + 1) / threads - all * index / threads;
                let steps = if name == "actor" { 1 } else { updates };
                NetworkPart::new(len, network.target.is_some(), steps)
            };
            learner.networks().into_iter().map(part).collect()
        };
        let shares = (0..threads).map(share).collect();
        Self { pool: ThreadPool::new(threads), shares, polyak, updates }
    }

    /// Does all steps of a cycle.
    pub(super) fn run(&mut self) {
        let Self { pool, shares, polyak, .. } = self;
        let instructions = InstructionSet::detect();
        let sizes = StepSizes::new(LEARNING_RATE, STEP);
        pool.for_each(shares, |parts| {
            for part in parts {
                for step in 1..=part.steps {
                    // Target networks change in the last update of a cycle.
                    let polyak = (part.has_target && step == part.steps).then_some(*polyak);
                    part.step(sizes, polyak, instructions);
                }
            }
        });
    }
}

impl NetworkPart {
    fn new(len: usize, has_target: bool, steps: u64) -> Self {
        // Arbitrary numbers, but without denormal moments, which are slow.
        let numbers = || (0..len).map(|i| 1.5 + (i as f32).sin()).collect::<Vec<_>>();
        Self {
            parameters: numbers(),
            first: numbers(),
            second: numbers(),
            target: numbers(),
            gradient: numbers(),
            has_target,
            steps,
        }
    }

    fn step(&mut self, sizes: StepSizes, polyak: Option<f32>, instructions: InstructionSet) {
        let Self { parameters, first, second, target, gradient, .. } = self;
        let target_step = polyak.map(|polyak| PolyakStep { target, polyak });
        adam(AdamPass { parameters, first, second, gradient, target_step, sizes }, instructions);
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;

    use super::*;
    use crate::learner::synthetic::tests::small_spec;

    #[test]
    fn threads_share_all_networks_of_the_algorithm() {
        let mut layers = Layers::new();
        layers.set("test", "algorithm.name", "td3").unwrap();
        layers.set("test", "learner.threads", "3").unwrap();
        let learner = Learner::new(layers.finish().unwrap(), &small_spec(), 1).unwrap();
        let mut steps = OptimiserSteps::new(&learner, 2);
        let shared: usize = steps.shares.iter().flatten().map(|part| part.gradient.len()).sum();
        let all: usize = learner.networks().iter().map(|(_, it)| it.gradient().len()).sum();
        assert_eq!(shared, all);
        let kind = |part: &NetworkPart| (part.has_target, part.steps);
        let first: Vec<_> = steps.shares[0].iter().map(kind).collect();
        assert_eq!((first, steps.updates), (vec![(true, 1), (true, 2), (true, 2)], 2));
        let moment = steps.shares[0][0].first[0];
        steps.run();
        assert_eq!(steps.shares[0][0].first[0], moment, "the mean of equal gradients");
        assert!((steps.shares[0][0].target[0] - 1.5).abs() < 1e-6);
    }
}
