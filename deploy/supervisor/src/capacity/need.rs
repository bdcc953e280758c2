//! Computes the resources that a run needs from its configuration.

use dmprl_shared::config::{AlgorithmName, ExperimentConfig, Hindsight};
use dmprl_shared::policy::Policy;
use dmprl_shared::segment::SegmentLayout;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::shared_memory::required_bytes;

/// Open files of any process of a run: pipes, logs, files of an environment [measured: 29].
const FILES: u64 = 64;
/// Additional open files in the learner per worker, for its services [measured: 6].
const FILES_PER_WORKER: u64 = 12;
/// Memory maps of any process; CPython with MuJoCo needs the most [measured: 400].
const MAPS: u64 = 1_024;
/// Additional memory maps in the learner per worker [measured: 4].
const MAPS_PER_WORKER: u64 = 12;
/// Processes and threads besides workers and update: supervisor, learner, evaluator.
const TASKS: u64 = 16;
/// Tasks of a worker: itself, its watchdog thread, and the thread that reads commands [measured:
/// 3].
const TASKS_PER_WORKER: u64 = 4;

/// Resources of a run. They are upper bounds, except for the parts that depend on an environment
/// whose spec is still unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Need {
    /// Workers of the run itself.
    pub workers: u64,
    /// Workers that may join.
    pub joined: u64,
    /// Workers of other hosts.
    pub remote: u64,
    /// Shared memory of all processes \[bytes\]; 0 for a run in one process.
    pub shared_memory_bytes: u64,
    /// Size of the replay at the end of the run \[bytes\].
    pub replay_bytes: u64,
    /// Open files of the process with the most.
    pub open_files: u64,
    /// Memory maps of the process with the most.
    pub maps: u64,
    /// Processes and threads in total.
    pub tasks: u64,
}

impl Need {
    /// Computes the resources of a run.
    ///
    /// - `config`: the resolved configuration.
    /// - `spec`: the environment, or `None` to assume the smallest one.
    pub fn of(config: &ExperimentConfig, spec: Option<&EnvSpec>) -> Self {
        // An environment that contradicts the configuration is rejected elsewhere, with a specific
        // error.
        let policy = spec.and_then(|spec| Policy::new(config.policy_description(spec)).ok());
        let smallest = SegmentLayout {
            segment_steps: config.policy.decision_steps(),
            observation_len: 1,
            action_len: 1,
        };
        let layout = policy.as_ref().map_or(smallest, Policy::layout);
        let parameters_len = policy.as_ref().map_or(0, Policy::parameters_len);
        let actors = &config.actors;
        let one_process = config.run.deterministic;
        let shared =
            || required_bytes(config.places(), actors.queue_segments, layout, parameters_len);
        let places = whole(config.places());
        let each = |base: u64, count: u64| base.saturating_add(count.saturating_mul(places));
        Self {
            workers: whole(actors.workers),
            joined: whole(actors.joined_max),
            remote: whole(config.bridge.places()),
            shared_memory_bytes: if one_process { 0 } else { shared() },
            replay_bytes: replay_bytes(config, layout),
            open_files: each(FILES, FILES_PER_WORKER),
            maps: each(MAPS, MAPS_PER_WORKER),
            tasks: each(TASKS, TASKS_PER_WORKER).saturating_add(whole(config.learner.threads)),
        }
    }
}

/// The replay allocates memory as it fills, so at most for the run's number of steps.
fn replay_bytes(config: &ExperimentConfig, layout: SegmentLayout) -> u64 {
    if config.algorithm.name == AlgorithmName::Ndp {
        return 0;
    }
    let copies = match config.replay.hindsight {
        Hindsight::None => 0,
        _ => whole(config.replay.hindsight_copies),
    };
    let inserted = config.run.steps.saturating_mul(copies.saturating_add(1));
    let segments = whole(config.replay.capacity_steps).min(inserted) / whole(layout.segment_steps);
    let segment = whole(layout.block_len()).saturating_mul(whole(size_of::<f32>()));
    segments.saturating_mul(segment)
}

fn whole(count: usize) -> u64 {
    u64::try_from(count).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::{Layers, Limits};

    use super::*;

    fn need(keys: &[(&str, &str)]) -> Need {
        let mut layers = Layers::new();
        keys.iter().for_each(|(key, value)| layers.set("--set", key, value).unwrap());
        Need::of(&layers.finish().unwrap().resolve(Limits { cores: 2 }).unwrap(), None)
    }

    #[test]
    fn the_need_of_the_largest_configuration_does_not_overflow() {
        let largest = need(&[
            ("actors.workers", "1024"),
            ("actors.queue_segments", "65536"),
            ("policy.segment_steps", "255"),
            ("dmp.integration_steps", "255"),
            ("replay.capacity_steps", "2147483648"),
            ("run.steps", "9223372036854775807"),
        ]);
        // Queues alone: workers × segments × (K + 1 observations, K actions, K rewards).
        assert!(largest.shared_memory_bytes > 1_024 * 65_536 * (256 + 255 + 255) * 4);
        assert!(largest.shared_memory_bytes < 1 << 40);
        assert_eq!(largest.replay_bytes, (2_147_483_648 / 255) * (256 + 255 + 255) * 4);
        assert_eq!(largest.open_files, 64 + (1_024 + 4) * 12);
    }

    #[test]
    fn one_process_needs_no_shared_memory_and_a_short_run_no_large_replay() {
        assert_eq!(need(&[("run.deterministic", "true")]).shared_memory_bytes, 0);
        let (short, long) = (need(&[("run.steps", "1000")]), need(&[]));
        assert!(short.replay_bytes < long.replay_bytes / 10, "{short:?} {long:?}");
    }
}
