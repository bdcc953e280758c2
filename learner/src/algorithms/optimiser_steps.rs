//! The optimiser's part of an update and nothing else, to measure its share. Called by
//! `dmprl bench learner`.

use super::Algorithm;
use crate::update::crew::Crew;
use crate::update::kernels::{AdamPass, Follow, InstructionSet, StepSizes, adam};
use crate::update::trained::Trained;

/// Late enough for the bias corrections to be what they are in a long run.
const STEP: u64 = 100_000;
/// So small that the numbers stay what they are, however often.
const LEARNING_RATE: f64 = 1e-12;

/// Numbers for Adam and the targets of an algorithm's networks, in memory of their own.
#[derive(Debug)]
pub struct OptimiserSteps {
    crew: Crew,
    /// Each thread's.
    shares: Vec<Vec<Slot>>,
    polyak: f32,
    /// Updates that one [`OptimiserSteps::run`] stands for.
    pub updates: u64,
}

/// One network, or one thread's share of it.
#[derive(Debug)]
struct Slot {
    /// Parameters, first and second moment, target, (P,) each.
    numbers: [Vec<f32>; 4],
    gradient: Vec<f32>,
    follows: bool,
    /// Steps of a cycle: an actor may rest in some updates.
    steps: u64,
}

impl OptimiserSteps {
    /// Those of `algorithm`, on so many threads.
    #[must_use]
    pub fn new(algorithm: &Algorithm, threads: usize, polyak: f32) -> Self {
        let updates = algorithm.products().updates;
        let share = |index: usize| {
            let slot = |(name, trained): (&str, &Trained)| {
                let all = trained.adam.moments.first.len();
                let len = all * (index + 1) / threads - all * index / threads;
                Slot::new(len, trained.target.is_some(), if name == "actor" { 1 } else { updates })
            };
            algorithm.networks().into_iter().map(slot).collect()
        };
        let shares = (0..threads).map(share).collect();
        Self { crew: Crew::new(threads), shares, polyak, updates }
    }

    /// All steps of `updates` updates.
    pub fn run(&mut self) {
        let Self { crew, shares, polyak, .. } = self;
        let instructions = InstructionSet::detect();
        let sizes = StepSizes::new(LEARNING_RATE, STEP);
        crew.each(shares, |slots| {
            for slot in slots {
                for step in 1..=slot.steps {
                    // Targets follow in the update that is the cycle's last.
                    let share = (slot.follows && step == slot.steps).then_some(*polyak);
                    slot.step(sizes, share, instructions);
                }
            }
        });
    }
}

impl Slot {
    fn new(len: usize, follows: bool, steps: u64) -> Self {
        // Any numbers will do whose moments are no denormals.
        let numbers = || (0..len).map(|i| 1.5 + (i as f32).sin()).collect::<Vec<_>>();
        let parts = [numbers(), numbers(), numbers(), numbers()];
        Self { numbers: parts, gradient: numbers(), follows, steps }
    }

    fn step(&mut self, sizes: StepSizes, polyak: Option<f32>, instructions: InstructionSet) {
        let [parameters, first, second, target] = &mut self.numbers;
        let follow = polyak.map(|polyak| Follow { target, polyak });
        let gradient = &self.gradient;
        adam(AdamPass { parameters, first, second, gradient, follow, sizes }, instructions);
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;
    use dmprl_shared::policy::Policy;

    use super::*;
    use crate::learner::tests::spec;

    #[test]
    fn the_threads_shares_are_the_algorithms_networks() {
        let mut layers = Layers::new();
        layers.set("test", "algorithm.name", "td3").unwrap();
        let config = layers.finish().unwrap();
        let policy = Policy::new(&config, &spec()).unwrap();
        let algorithm = Algorithm::new(&config, &policy).unwrap();
        let mut steps = OptimiserSteps::new(&algorithm, 3, 0.5);
        let shared: usize = steps.shares.iter().flatten().map(|slot| slot.gradient.len()).sum();
        let all: usize = algorithm.networks().iter().map(|(_, it)| it.gradient().len()).sum();
        assert_eq!(shared, all);
        let of = |slot: &Slot| (slot.follows, slot.steps);
        let first: Vec<_> = steps.shares[0].iter().map(of).collect();
        assert_eq!((first, steps.updates), (vec![(true, 1), (true, 2), (true, 2)], 2));
        let moment = steps.shares[0][0].numbers[1][0];
        steps.run();
        assert_eq!(steps.shares[0][0].numbers[1][0], moment, "the mean of equal gradients");
        assert!((steps.shares[0][0].numbers[3][0] - 1.5).abs() < 1e-6);
    }
}
