//! Tests of the tasks' values under each preset.

use super::*;
use crate::config::{ExperimentConfig, Layers, PRESETS};

fn config(name: &str, preset: usize) -> ExperimentConfig {
    let task = task_defaults(name).unwrap();
    let mut layers = Layers::new();
    layers.add(task.name, task.table()).unwrap();
    layers.add(PRESETS[preset].name, PRESETS[preset].table()).unwrap();
    layers.add(task.name, task.over_preset(PRESETS[preset].name)).unwrap();
    layers.finish().unwrap()
}

#[test]
fn every_task_is_complete() {
    for task in &TASKS {
        for preset in 0..PRESETS.len() {
            let config = config(task.name, preset);
            assert_eq!((config.task.name.as_str(), config.task.id.as_str()), (task.name, task.id));
            assert_eq!(config.task.start_sources.len(), task.action_low.len(), "{}", task.name);
        }
    }
}

#[test]
fn tasks_of_the_panda_with_objects_have_their_own_discount_in_preset_goal() {
    let goal = PRESETS.iter().position(|preset| preset.name == "goal").unwrap();
    for (name, discount) in [("panda-push", 0.95), ("panda-stack", 0.95), ("pusher", 0.98)] {
        assert_eq!(config(name, goal).algorithm.discount, discount);
    }
}

#[test]
fn easy_tasks_have_small_networks_and_larger_steps_in_preset_fast() {
    let fast = PRESETS.iter().position(|preset| preset.name == "fast").unwrap();
    for (name, hidden, learning_rate) in [
        ("reacher", 128, 0.002),
        ("reacher-v1", 128, 0.002),
        ("panda-reach-joints", 64, 0.002),
        ("pusher", 256, 0.001),
    ] {
        let config = config(name, fast);
        assert_eq!(config.policy.hidden, [hidden; 2], "{name}");
        let algorithm = config.algorithm;
        assert_eq!((algorithm.critic_hidden, algorithm.batch_size), (vec![hidden; 2], 128));
        let rates = [algorithm.critic_learning_rate, algorithm.actor_learning_rate];
        assert_eq!(rates, [learning_rate; 2], "{name}");
    }
}

#[test]
fn preset_paper_uses_the_panda_column_of_table_2() {
    for (name, discount, actor, warm_up, capacity) in [
        ("reacher-v1", 0.99, 5e-4, 10_000, 1_000_000),
        ("panda-reach", 0.95, 3e-4, 2_000, 100_000),
        ("panda-reach-joints", 0.95, 3e-4, 2_000, 100_000),
    ] {
        let config = config(name, 1);
        let algorithm = config.algorithm;
        assert_eq!((algorithm.discount, algorithm.actor_learning_rate), (discount, actor));
        assert_eq!(config.exploration.warm_up_steps, warm_up);
        assert_eq!(config.replay.capacity_steps, capacity);
    }
}
