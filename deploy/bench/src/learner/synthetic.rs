//! Fills a replay with synthetic segments of a task's sizes.

use anyhow::Context;
use dmprl_learner::learner::Learner;
use dmprl_shared::segment::{LAYOUT_VERSION, Segment, SegmentHeader, TRUNCATED, block_checksum};
use dmprl_shared::spec::EnvSpec;

/// Run id in the synthetic segments.
pub(super) const RUN_ID: u64 = 1;

/// Number of steps that are enough for batches not to come from the processor's caches.
pub(crate) const STEPS: usize = 100_000;

/// Phase step between two values. The sine never repeats, because 0.37 / 2 pi is irrational.
const STRIDE: f32 = 0.37;

/// Inserts complete episodes, one after the other, until the replay has `steps` or is full. Returns
/// the number of steps in it.
pub(crate) fn fill(learner: &mut Learner, spec: &EnvSpec, steps: usize) -> anyhow::Result<usize> {
    let layout = learner.policy().layout();
    let mut segment = Segment::zeroed(layout);
    let capacity = learner.config().replay.capacity_steps;
    let steps = steps.min(capacity);
    let (mut done, mut numbers, mut sequence, mut episode) = (0, 0, 0, 0);
    while done < steps {
        let mut episode_step = 0;
        while episode_step < spec.episode_steps {
            let steps_len = (spec.episode_steps - episode_step).min(layout.segment_steps as u32);
            for value in &mut segment.block {
                numbers += 1;
                *value = (numbers as f32 * STRIDE).sin();
            }
            sequence += 1;
            segment.header = SegmentHeader {
                layout_version: LAYOUT_VERSION,
                flags: if episode_step + steps_len == spec.episode_steps { TRUNCATED } else { 0 },
                run_id: RUN_ID,
                architecture_hash: learner.policy().architecture_hash(),
                sequence,
                episode,
                episode_step,
                steps_len,
                segment_steps: layout.segment_steps as u32,
                observation_len: layout.observation_len as u32,
                action_len: layout.action_len as u32,
                checksum: block_checksum(&segment.block),
                ..SegmentHeader::default()
            };
            learner.insert(&segment).context("a synthetic segment was rejected")?;
            episode_step += steps_len;
        }
        done += spec.episode_steps as usize;
        episode += 1;
    }
    Ok(done.min(capacity))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Returns the spec of a small environment.
    pub(in super::super) fn small_spec() -> EnvSpec {
        EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); 2], 0.02, 10)
    }
}
