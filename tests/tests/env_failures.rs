//! Rollout and evaluation with environments that fail, in a real interpreter.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::sync::OnceLock;
use std::sync::atomic::AtomicBool;

use dmprl_actors::evaluate::{Episodes, Evaluation, Evaluator};
use dmprl_actors::python_env::{Interpreter, InterpreterOptions, PythonEnvironments};
use dmprl_actors::rollout::{Identity, Rollout, RolloutError};
use dmprl_shared::config::{Execution, ExperimentConfig, Layers, TaskConfig};
use dmprl_shared::segment::{SegmentHeader, TRUNCATED};
use dmprl_tests::{tiny_envs_dir, venv};

const ENVS: usize = 2;

fn config(failures_max: u32) -> ExperimentConfig {
    let mut layers = Layers::new();
    for (key, value) in [
        ("actors.envs_per_worker", ENVS.to_string()),
        ("actors.env_failures_max", failures_max.to_string()),
        ("policy.hidden", "[8]".to_owned()),
    ] {
        layers.set("test", key, &value).unwrap();
    }
    layers.finish().unwrap()
}

fn environments(task_id: &str, steps: usize) -> PythonEnvironments {
    static INTERPRETER: OnceLock<Interpreter> = OnceLock::new();
    let start = || {
        let (venv, python_path) = (venv().venv.clone(), vec![tiny_envs_dir()]);
        Interpreter::start(&InterpreterOptions { venv, python_path }).unwrap()
    };
    let interpreter = INTERPRETER.get_or_init(start);
    PythonEnvironments::start(interpreter, &TaskConfig::with_id(task_id), ENVS, steps).unwrap()
}

/// Returns the headers that a worker delivers in this many calls, and the error that stopped it
/// earlier.
fn delivered(rollout: &mut Rollout, calls: usize) -> (Vec<SegmentHeader>, Option<RolloutError>) {
    let mut headers = Vec::new();
    for _ in 0..calls {
        let result = rollout.segment(&mut |header, block| {
            assert!(block.iter().all(|value| value.is_finite()));
            headers.push(*header);
            Ok::<(), RolloutError>(())
        });
        if let Err(error) = result {
            return (headers, Some(error));
        }
    }
    (headers, None)
}

fn started(task_id: &str, failures_max: u32) -> Rollout {
    let identity = Identity { run_id: 1, worker_id: 0, incarnation: 0, seed_index: 0 };
    Rollout::start(&config(failures_max), environments(task_id, 5), identity).unwrap()
}

fn of_env(headers: &[SegmentHeader], env: u32) -> Vec<(u32, u32, u32)> {
    let headers = headers.iter().filter(|header| header.env_index == env);
    headers.map(|header| (header.episode, header.episode_step, header.steps_len)).collect()
}

/// Episodes have seven steps, and a life ends in its 23rd: three complete episodes, then a segment
/// that must not be delivered.
#[test]
fn a_failed_segment_is_left_out_and_the_next_one_begins_another_episode() {
    for fault in ["Raise", "Observation", "Reward"] {
        let mut rollout = started(&format!("tiny_envs:Faulty{fault}-v0"), 0);
        let (headers, error) = delivered(&mut rollout, 6);
        assert!(error.is_none() && rollout.take_failures().is_empty());
        let whole = [(0, 0, 5), (0, 5, 2), (1, 0, 5), (1, 5, 2), (2, 0, 5), (2, 5, 2)];
        assert_eq!(of_env(&headers, 1), whole);
        // The first failure already exceeds the limit; delivered segments remain.
        let (headers, error) = delivered(&mut rollout, 1);
        assert!(headers.is_empty());
        assert!(
            matches!(error, Some(RolloutError::FailureBudgetExceeded { count: 1, .. })),
            "{error:?}"
        );

        let mut rollout = started(&format!("tiny_envs:Faulty{fault}-v0"), 1);
        let (headers, error) = delivered(&mut rollout, 3 * 7);
        assert!(error.is_none(), "episodes were completed in between: {error:?}");
        let sequence: Vec<u64> = headers.iter().map(|header| header.sequence).collect();
        assert_eq!(sequence, (1..=(3 * 6 * ENVS as u64)).collect::<Vec<_>>());
        for env in 0..ENVS as u32 {
            let lives = [0, 4, 8].map(|first| whole.map(|(e, step, len)| (first + e, step, len)));
            assert_eq!(of_env(&headers, env), lives.concat());
        }
        let failures = rollout.take_failures();
        assert_eq!(failures.len(), 3 * ENVS, "{failures:?}");
        assert!(failures[1].contains("environment 1, step 1 of the segment: "), "{failures:?}");
    }
}

#[test]
fn an_environment_that_completes_no_episode_ends_its_worker_with_the_cause() {
    let mut rollout = started("tiny_envs:Hopeless-v0", 3);
    let (headers, error) = delivered(&mut rollout, 10);
    assert!(headers.is_empty());
    let message = error.unwrap().to_string();
    for part in ["environment 0 has failed 4 times", "env_failures_max", "the gripper fell off"] {
        assert!(message.contains(part), "{part}: {message}");
    }
    assert_eq!(rollout.take_failures().len(), 4 * ENVS);
}

/// The environment does not detect its own failure and cannot be recreated, so it is reset.
#[test]
fn a_foreign_environment_that_hands_out_nan_is_reset_and_goes_on() {
    let mut rollout = started("tiny_envs:BatchOfNan", 1);
    let (headers, error) = delivered(&mut rollout, 4);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(of_env(&headers, 0), [(0, 0, 5), (1, 0, 5), (1, 5, 5)]);
    assert_eq!(of_env(&headers, 1), [(0, 0, 5), (0, 5, 5), (0, 10, 5), (0, 15, 5)]);
    let sequence: Vec<u64> = headers.iter().map(|header| header.sequence).collect();
    assert_eq!(sequence, [1, 2, 3, 4, 5, 6, 7]);
    let failures = rollout.take_failures();
    assert!(failures[0].contains("environment 0, step 0 of the segment: reward is NaN"));
    assert_eq!(failures.len(), 1);
}

fn evaluated(
    task_id: &str,
    execution: Execution,
) -> (Evaluator, Result<Option<Evaluation>, RolloutError>) {
    let mut config = config(0);
    config.policy.execution = execution;
    let environments = environments(task_id, config.policy.execution_steps());
    let mut evaluator = Evaluator::new(&config, environments, ENVS).unwrap();
    let len = evaluator.policy().parameters_len();
    let parameters: Vec<f32> = (0..len).map(|i| ((i * 37) % 129) as f32 / 640.0 - 0.1).collect();
    let stop = AtomicBool::new(false);
    let episodes = Episodes { count: 4 * ENVS, first_seed: 50, stop: &stop };
    let evaluation = evaluator.evaluate(&parameters, episodes);
    (evaluator, evaluation)
}

/// `Long` is the same environment without the fault.
#[test]
fn an_episode_that_fails_in_an_evaluation_is_repeated_with_its_seed() {
    for execution in [Execution::Segment, Execution::Ensemble] {
        let (mut evaluator, evaluation) = evaluated("tiny_envs:FaultyRaise-v0", execution);
        assert_eq!(evaluator.take_failures().len(), ENVS, "one in the fourth episode of each");
        let (_, expected) = evaluated("tiny_envs:Long-v0", execution);
        let expected = expected.unwrap().unwrap();
        assert!(expected.returns.iter().all(|return_| *return_ != 0.0), "{expected:?}");
        assert_eq!(evaluation.unwrap().unwrap(), expected, "{execution:?}");
    }
}

#[test]
fn an_episode_that_fails_again_ends_the_evaluation_and_says_which() {
    let (mut evaluator, evaluation) = evaluated("tiny_envs:Hopeless-v0", Execution::Segment);
    let message = evaluation.unwrap_err().to_string();
    assert!(message.contains("the episode with seed 50 has failed 2 times"), "{message}");
    assert!(message.contains("environment 0, step 0 of the segment: ValueError"), "{message}");
    assert_eq!(evaluator.take_failures().len(), 2 * ENVS);
}

#[test]
fn flags_of_a_life_without_faults_stay_as_they_were() {
    let (headers, error) = delivered(&mut started("tiny_envs:Long-v0", 0), 2);
    assert!(error.is_none());
    let flags: Vec<u32> = headers.iter().map(|header| header.flags & TRUNCATED).collect();
    assert_eq!(flags, [0, 0, TRUNCATED, TRUNCATED]);
}
