//! The batch of the next update, sampled on another thread while a GPU updates. Called by
//! [`super::OffPolicy`].
//!
//! The learner's thread starts the GPU's operations one by one and waits for the last. Sampling
//! takes 2.6 ms for 4096 rows (docs/decisions/0114-cuda-tree-from-wheels.md), which would be added
//! to every update. A batch that is sampled ahead lacks the segments that arrive before its update,
//! and what hindsight reads from them.

use std::panic;
use std::thread::{self, ScopedJoinHandle};

use crate::algorithms::{Batch, BatchShape, NoWindow};
use crate::replay::Sampler;

/// A batch for the next update, if there is one.
#[derive(Debug)]
pub(super) struct NextBatch {
    batch: Batch,
    /// The sampler after it has drawn the batch. `None` if there is no batch.
    sampler: Option<Sampler>,
}

impl NextBatch {
    /// Allocates the buffers of a batch.
    pub(super) fn new(shape: BatchShape) -> Self {
        Self { batch: Batch::new(shape), sampler: None }
    }

    /// Moves the batch into `batch`, and `sampler` past its draws. Returns false if there is none.
    /// Nothing else may have drawn from `sampler` since the batch was sampled.
    pub(super) fn take(&mut self, batch: &mut Batch, sampler: &mut Sampler) -> bool {
        let Some(advanced) = self.sampler.take() else { return false };
        std::mem::swap(&mut self.batch, batch);
        *sampler = advanced;
        true
    }

    /// Calls `sample` on another thread and `update` on this one, and returns the result of the
    /// latter. `sampler` stays as it is until the batch is taken, so that a run that resumes from a
    /// checkpoint in between continues the same random stream, although with newer segments.
    pub(super) fn sample_during<T>(
        &mut self,
        sampler: &Sampler,
        sample: impl FnOnce(&mut Batch, &mut Sampler) -> Result<(), NoWindow> + Send,
        update: impl FnOnce() -> T,
    ) -> T {
        let (batch, mut sampler) = (&mut self.batch, sampler.clone());
        let (sampled, result) = thread::scope(|scope| {
            let thread = thread::Builder::new().name("sample".into());
            let sampling = thread.spawn_scoped(scope, || sample(batch, &mut sampler));
            let result = update();
            (sampling.map(ScopedJoinHandle::join), result)
        });
        // Without a window or a thread, the next update samples by itself, and fails if there still
        // is no window.
        self.sampler = match sampled {
            Ok(Ok(sampled)) => sampled.is_ok().then_some(sampler),
            Ok(Err(panicked)) => panic::resume_unwind(panicked),
            Err(_) => None,
        };
        result
    }

    /// Drops the batch, as if it had not been sampled.
    pub(super) fn discard(&mut self) {
        self.sampler = None;
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;
    use dmprl_shared::segment::{SegmentHeader, TRUNCATED};

    use super::*;
    use crate::learner::Learner;
    use crate::learner::tests::spec;
    use crate::off_policy::OffPolicy;
    use crate::regime::Regime;

    fn learner() -> Learner {
        let mut layers = Layers::new();
        for (key, value) in [
            ("policy.hidden", "[8]"),
            ("algorithm.critic_hidden", "[8]"),
            ("algorithm.batch_size", "16"),
            ("policy.normalise_observations", "false"),
        ] {
            layers.set("test", key, value).unwrap();
        }
        let mut learner = Learner::new(layers.finish().unwrap(), &spec(), 1).unwrap();
        (0..5).for_each(|episode| insert(&mut learner, episode));
        learner
    }

    /// The same learner, which samples ahead as on a GPU.
    fn learner_ahead() -> Learner {
        let mut learner = learner();
        let off_policy = off_policy(&mut learner);
        off_policy.next_batch = Some(NextBatch::new(off_policy.algorithm.batch_shape()));
        learner
    }

    fn off_policy(learner: &mut Learner) -> &mut OffPolicy {
        match &mut learner.regime {
            Regime::OffPolicy(off_policy) => off_policy,
            Regime::OnPolicy(_) => panic!("an on-policy algorithm"),
        }
    }

    /// Inserts an episode of one segment.
    fn insert(learner: &mut Learner, episode: u32) {
        let layout = learner.replay.layout();
        let numbers = (0..layout.block_len()).map(|at| (at as f32 + 100.0 * episode as f32).sin());
        let steps_len = layout.segment_steps as u32;
        let header = SegmentHeader { episode, steps_len, flags: TRUNCATED, ..Default::default() };
        learner.replay.insert(&header, &numbers.collect::<Vec<_>>());
    }

    fn policy(learner: &Learner) -> Vec<f32> {
        let mut values = vec![0.0; learner.policy().parameters_len()];
        learner.regime.read_policy(&mut values).unwrap();
        values
    }

    #[test]
    fn a_batch_that_is_sampled_ahead_is_that_of_the_next_update() {
        let (mut plain, mut ahead) = (learner(), learner_ahead());
        for update in 1..=4 {
            plain.update().unwrap();
            ahead.update().unwrap();
            assert_eq!(policy(&plain), policy(&ahead), "update {update}");
            // As a checkpoint would store it.
            assert_eq!(plain.sampler.random_mut(), ahead.sampler.random_mut(), "update {update}");
        }
    }

    #[test]
    fn a_batch_lacks_later_segments_unless_it_is_discarded() {
        let (mut plain, mut ahead, mut discarding) = (learner(), learner_ahead(), learner_ahead());
        for learner in [&mut plain, &mut ahead, &mut discarding] {
            learner.update().unwrap();
            insert(learner, 5);
        }
        // As when the normalisation of observations changes.
        discarding.for_each_network(|_, _| Ok::<(), ()>(())).unwrap();
        for learner in [&mut plain, &mut ahead, &mut discarding] {
            learner.update().unwrap();
        }
        assert_ne!(policy(&plain), policy(&ahead));
        assert_eq!(policy(&plain), policy(&discarding));
    }

    #[test]
    fn without_a_window_there_is_no_batch() {
        let mut learner = learner_ahead();
        let shape = off_policy(&mut learner).algorithm.batch_shape();
        let (mut next, mut batch) = (NextBatch::new(shape), Batch::new(shape));
        let none = |_: &mut Batch, _: &mut Sampler| Err(NoWindow { segments: 0, steps: 5 });
        assert_eq!(next.sample_during(&learner.sampler, none, || 3), 3);
        assert!(!next.take(&mut batch, &mut learner.sampler));
    }
}
