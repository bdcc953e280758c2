//! Checks that an update allocates nothing once its buffers exist.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

#[path = "../../shared/tests/counting_allocator/mod.rs"]
mod counting_allocator;
#[path = "../../tests/src/skipped.rs"]
mod skipped;

use counting_allocator::allocations_of;
use dmprl_learner::algorithms::{Algorithm, Batch};
use dmprl_learner::demonstrations::Demonstration;
use dmprl_learner::learner::Learner;
use dmprl_learner::update::kernels::bf16::Bf16;
use dmprl_shared::config::{Layers, Limits};
use dmprl_shared::goal_rule::{GoalReward, GoalRule, Norm};
use dmprl_shared::policy::Policy;
use dmprl_shared::segment::{LAYOUT_VERSION, Segment, SegmentHeader, block_checksum};
use dmprl_shared::spec::EnvSpec;
use skipped::skipped;

fn spec() -> EnvSpec {
    EnvSpec {
        goal_rule: Some(Box::new(GoalRule {
            achieved: 0,
            desired: 3,
            goal_len: 3,
            components: vec![0, 1, 2],
            norm: Norm::Euclidean,
            reward: GoalReward::Sparse { threshold: 0.05, reached: 0.0, missed: -1.0 },
            ends_within: None,
        })),
        ..EnvSpec::new("Test-v0", 9, &[(-1.0, 1.0); 2], 0.05, 50)
    }
}

/// The configuration of an update.
#[derive(Debug, Clone, Copy)]
struct Case {
    algorithm: &'static str,
    policy: &'static str,
    layer_norm: &'static str,
}

/// Returns the allocations of twenty updates, after the first four.
fn allocations(case: Case, precision: &str, threads: &str) -> u64 {
    let Case { algorithm, policy, layer_norm } = case;
    let mut layers = Layers::new();
    let keys = [
        ("algorithm.name", algorithm),
        ("policy.kind", policy),
        ("algorithm.critic_layer_norm", layer_norm),
        ("learner.precision", precision),
        ("learner.threads", threads),
        // Three shards; the last is short and has an odd number of rows.
        ("algorithm.batch_size", "133"),
    ];
    for (key, value) in keys {
        layers.set("test", key, value).unwrap();
    }
    if policy == "mlp" {
        layers.set("test", "policy.segment_steps", "1").unwrap();
    }
    let config = layers.finish().unwrap();
    let spec = spec();
    let policy = Policy::new(config.policy_description(&spec)).unwrap();
    let mut algorithm = Algorithm::new(&config, &policy, spec.goal_rule.as_deref()).unwrap();
    let batch = Batch::new(algorithm.batch_shape());
    let mut update = |count| {
        algorithm.update(&policy, &batch, count).unwrap();
    };
    (1..5).for_each(&mut update);
    allocations_of(|| (5..25).for_each(&mut update))
}

/// Returns the allocations of twenty segments and the updates owed for them, including sampling and
/// normalisation, after enough segments that all buffers exist.
fn allocations_of_a_learner(algorithm: &str, hindsight: &str) -> u64 {
    let mut layers = Layers::new();
    // On-policy algorithms have no penalty on action changes.
    let penalty = if algorithm == "ndp" { "0.0" } else { "0.2" };
    let outcome_model = if hindsight == "none" { "false" } else { "true" };
    let keys = [
        ("algorithm.name", algorithm),
        ("algorithm.action_rate_penalty", penalty),
        ("algorithm.action_acceleration_penalty", penalty),
        ("algorithm.saturation_penalty", penalty),
        ("algorithm.imitation_penalty", penalty),
        ("algorithm.outcome_model", outcome_model),
        ("replay.hindsight", hindsight),
        ("policy.start", "zero"),
        ("policy.normalise_observations", "true"),
        ("exploration.warm_up_steps", "0"),
        ("algorithm.batch_size", "64"),
        ("algorithm.ndp.rollout_segments", "4"),
        ("algorithm.ndp.minibatches", "2"),
    ];
    for (key, value) in keys {
        layers.set("test", key, value).unwrap();
    }
    let config = layers.finish().unwrap().resolve(Limits { cores: 1 }).unwrap();
    let mut learner = Learner::new(config, &spec(), 1).unwrap();
    assert_eq!(learner.hindsight.is_some(), hindsight != "none");
    let layout = learner.policy().layout();
    let mut segment = Segment { block: vec![0.1; layout.block_len()], ..Segment::default() };
    segment.header = SegmentHeader {
        layout_version: LAYOUT_VERSION,
        run_id: 1,
        architecture_hash: learner.policy().architecture_hash(),
        incarnation: 1,
        steps_len: layout.segment_steps as u32,
        segment_steps: layout.segment_steps as u32,
        observation_len: layout.observation_len as u32,
        action_len: layout.action_len as u32,
        checksum: block_checksum(&segment.block),
        ..SegmentHeader::default()
    };
    let mut updates = 0;
    let mut turn = |sequence| {
        if learner.publish_due(1) {
            segment.header.policy_version = learner.next_snapshot().unwrap().version;
        }
        segment.header.sequence = sequence;
        segment.header.episode = sequence as u32;
        learner.insert(&segment).unwrap();
        while learner.update_due() {
            learner.update().unwrap();
            updates += 1;
        }
    };
    // The normalisation is updated at each doubling of the observations, last before segment 40.
    (1..=40).for_each(&mut turn);
    let allocated = allocations_of(|| (41..=60).for_each(&mut turn));
    assert!(updates >= 60, "{algorithm}: {updates} updates show nothing");
    allocated
}

/// Returns the allocations of twenty updates of an actor that also imitates, after the first four.
fn allocations_of_imitation() -> u64 {
    let mut layers = Layers::new();
    layers.set("test", "demonstrations.files", "['some.npz']").unwrap();
    layers.set("test", "demonstrations.cloning_updates", "1").unwrap();
    let mut learner = Learner::new(layers.finish().unwrap(), &spec(), 1).unwrap();
    let mut steps = Demonstration {
        observations: vec![0.1; 30 * 9],
        actions: vec![0.2; 30 * 2],
        rewards: vec![0.3; 30],
        next_observations: vec![0.1; 30 * 9],
        terminated: vec![false; 30],
        truncated: vec![false; 30],
    };
    steps.truncated[29] = true;
    learner.demonstrate(&[steps]).unwrap();
    (1..5).for_each(|_| learner.update().unwrap());
    allocations_of(|| (5..25).for_each(|_| learner.update().unwrap()))
}

/// The only test of its binary, because the counter covers all threads.
#[test]
fn no_update_allocates_once_its_buffers_are_made() {
    let has_bf16 = Bf16::detect().is_some();
    assert_eq!(allocations_of_imitation(), 0, "imitation");
    for algorithm in ["ddpg", "td3", "sac", "ndp"] {
        assert_eq!(allocations_of_a_learner(algorithm, "none"), 0, "a learner of {algorithm}");
    }
    assert_eq!(allocations_of_a_learner("td3", "future"), 0, "a learner with hindsight");
    for algorithm in ["ddpg", "td3", "sac"] {
        for (policy, layer_norm) in [("dmp", "false"), ("mlp", "false"), ("mlp", "true")] {
            let what = Case { algorithm, policy, layer_norm };
            assert_eq!(allocations(what, "f32", "2"), 0, "{what:?}");
            if has_bf16 {
                // On one thread, because each thread allocates its buffer for pairs at its first
                // part.
                assert_eq!(allocations(what, "bf16", "1"), 0, "{what:?} bf16");
            }
        }
    }
    if !has_bf16 {
        let remedy = "run the tests on a processor with AVX512-BF16";
        skipped("TEST_BF16_REQUIRED", "allocations of updates in 16 bits", remedy);
    }
}
