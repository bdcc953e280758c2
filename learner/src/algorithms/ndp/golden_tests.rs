//! Compares a rollout and twenty updates with an independent implementation in PyTorch. The numbers
//! in tests/golden/update/ndp.safetensors come from make_golden_ndp.py in the same folder.

use std::collections::BTreeMap;

use dmprl_shared::segment::{SegmentHeader, TERMINATED, TRUNCATED};

use super::super::golden_tests::{FIRST, Golden, folder};
use super::*;
use crate::learner::tests::spec;

/// Returns segment `index` of the file's rollout.
fn segment(golden: &Golden, policy: &Policy, index: usize) -> Segment {
    let part = |name: &str, width: usize| {
        &golden.tensors[&format!("rollout.{name}")][index * width..(index + 1) * width]
    };
    let number = |name: &str| part(name, 1)[0] as u32;
    let layout = policy.layout();
    let mut segment = Segment::zeroed(layout);
    let (observations, actions, rewards) = layout.split_mut(&mut segment.block);
    for (name, out) in [("observations", observations), ("actions", actions), ("rewards", rewards)]
    {
        out.copy_from_slice(part(name, out.len()));
    }
    segment.header = SegmentHeader {
        policy_version: 1,
        flags: (number("terminated") * TERMINATED) | (number("truncated") * TRUNCATED),
        env_index: number("environment"),
        episode: number("episode"),
        episode_step: number("episode_step"),
        steps_len: number("steps_len"),
        ..SegmentHeader::default()
    };
    segment
}

/// Returns the evaluation of the rollout.
fn evaluation(ndp: &Ndp) -> BTreeMap<String, Vec<f32>> {
    let RolloutBuffer { values, last_values, advantages, returns, .. } = &ndp.rollout;
    [
        ("values", values),
        ("last_values", last_values),
        ("advantages", advantages),
        ("returns", returns),
        ("log_densities", &ndp.log_densities),
    ]
    .map(|(name, values)| (name.to_owned(), values.clone()))
    .into()
}

#[test]
fn a_rollout_and_its_updates_equal_those_of_an_independent_implementation() {
    let mut golden = Golden::read(&folder().join("ndp.safetensors"));
    let mut config = golden.config();
    config.learner.threads = 2;
    let policy = Policy::new(config.policy_description(&spec())).unwrap();
    let mut ndp = Ndp::new(&config, &policy).unwrap();
    let networks =
        [("actor", &mut ndp.actor), ("log_std", &mut ndp.log_std), ("critic", &mut ndp.critic)];
    for (name, network) in networks {
        network.parameters.set(&golden.tensors[&format!("initial.{name}")]).unwrap();
    }
    ndp.policy_published(1);
    for index in 0..config.algorithm.ndp.rollout_segments {
        assert!(ndp.try_insert(&segment(&golden, &policy, index)));
    }
    let mut random = seeds::stream(1, "test", 0);
    for update in 1..=golden.updates() {
        let context = UpdateContext { policy: &policy, normaliser: None, progress: 0.5 };
        let losses = ndp.update(context, &mut random);
        if update == 1 {
            golden.compare_with("judged.", &evaluation(&ndp), FIRST);
            let left = golden.tensors.keys().filter(|name| name.starts_with("judged."));
            assert_eq!(left.count(), 0);
        }
        let mut ours = BTreeMap::from([
            ("loss.policy".to_owned(), vec![losses.policy_loss]),
            ("loss.value".to_owned(), vec![losses.value_loss]),
            ("loss.entropy".to_owned(), vec![losses.entropy]),
        ]);
        let networks = [("actor", &ndp.actor), ("log_std", &ndp.log_std), ("critic", &ndp.critic)];
        for (name, network) in networks {
            ours.insert(format!("gradient.{name}"), network.gradient().to_vec());
            ours.insert(format!("parameters.{name}"), network.parameters.values().to_vec());
        }
        golden.compare(update, &ours);
    }
    golden.assert_all_compared();
}
