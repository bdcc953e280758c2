//! A small learner with its configuration, segments and folders.

use std::path::Path;

use dmprl_learner::learner::{Learner, LearnerError};
use dmprl_shared::config::{ExperimentConfig, Layers, Limits};
use dmprl_shared::segment::{
    HINDSIGHT, LAYOUT_VERSION, Segment, SegmentHeader, TERMINATED, TRUNCATED, block_checksum,
};
use dmprl_shared::spec::EnvSpec;

use crate::mutate::Random;

pub const RUN_ID: u64 = 7;
pub const WORKERS: u32 = 2;
pub const ENVS: u32 = 3;

pub fn spec() -> EnvSpec {
    EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); 2], 0.02, 10)
}

/// Small sizes, so that a case takes a fraction of a millisecond; no worker may join.
pub fn config(keys: &[(&str, &str)]) -> ExperimentConfig {
    let mut layers = Layers::new();
    let small = [
        ("policy.hidden", "[4]"),
        ("algorithm.critic_hidden", "[4]"),
        ("algorithm.batch_size", "4"),
        ("exploration.warm_up_steps", "20"),
        ("replay.capacity_steps", "1000"),
        ("actors.workers", "2"),
        ("actors.joined_max", "0"),
        ("actors.envs_per_worker", "3"),
        ("learner.threads", "1"),
    ];
    for (key, value) in small.iter().chain(keys) {
        layers.set("test", key, value).unwrap();
    }
    layers.finish().unwrap().resolve(Limits { cores: 2 }).unwrap()
}

pub fn learner(keys: &[(&str, &str)]) -> Result<Learner, LearnerError> {
    Learner::new(config(keys), &spec(), RUN_ID)
}

/// A valid segment, the `number`th in total, from the workers in turn.
pub fn segment(random: &mut Random, learner: &Learner, number: u64) -> Segment {
    let layout = learner.policy().layout();
    let mut segment = Segment::zeroed(layout);
    segment.block.iter_mut().for_each(|value| *value = random.unit());
    let flags = *random.pick(&[0, 0, 0, TERMINATED, TRUNCATED, HINDSIGHT, HINDSIGHT | TERMINATED]);
    let ends = flags & (TERMINATED | TRUNCATED) != 0;
    let steps = layout.segment_steps;
    let steps_len = if ends { 1 + random.below(steps) } else { steps };
    segment.header = SegmentHeader {
        layout_version: LAYOUT_VERSION,
        flags,
        run_id: RUN_ID,
        architecture_hash: learner.policy().architecture_hash(),
        policy_version: 1,
        sequence: number / u64::from(WORKERS) + 1,
        worker_id: (number % u64::from(WORKERS)) as u32,
        env_index: random.below(ENVS as usize) as u32,
        episode: random.below(3) as u32,
        episode_step: random.below(3) as u32 * 5,
        steps_len: steps_len as u32,
        segment_steps: steps as u32,
        observation_len: layout.observation_len as u32,
        action_len: layout.action_len as u32,
        checksum: block_checksum(&segment.block),
        ..SegmentHeader::default()
    };
    segment
}

/// Returns a folder in memory, where the system has one.
pub fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    tempfile::Builder::new().prefix("dz-").tempdir_in(parent).unwrap()
}
