//! A real interpreter with real environments. All tests of this file share one interpreter, because
//! a process can have only one.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::{process::Command, sync::OnceLock};

use dmprl_actors::python_env::{
    Interpreter, InterpreterOptions, PythonEnvironments, PythonError, SUCCESS_NO, SUCCESS_YES,
};
use dmprl_shared::config::{TASKS, TaskConfig};
use dmprl_tests::{tiny_envs_dir, venv};

fn options() -> InterpreterOptions {
    InterpreterOptions { venv: venv().venv.clone(), python_path: vec![tiny_envs_dir()] }
}

fn interpreter() -> &'static Interpreter {
    static INTERPRETER: OnceLock<Interpreter> = OnceLock::new();
    INTERPRETER.get_or_init(|| Interpreter::start(&options()).unwrap())
}

fn started(task_id: &str, env_count: usize, segment_steps: usize) -> PythonEnvironments {
    let task = TaskConfig::with_id(task_id);
    let mut envs =
        PythonEnvironments::start(interpreter(), &task, env_count, segment_steps).unwrap();
    let seeds: Vec<u64> = (7..).take(env_count).collect();
    envs.reset(&vec![true; env_count], &seeds).unwrap();
    envs
}

fn refused(task: &TaskConfig) -> String {
    PythonEnvironments::start(interpreter(), task, 1, 5).err().unwrap().to_string()
}

/// Any sequence of actions works if both sides compute the same; these are exact in f32.
fn action_at(index: usize) -> f64 {
    ((index * 37) % 129) as f64 / 64.0 - 1.0
}

#[test]
fn spec_of_reacher_is_gymnasiums() {
    let envs = started("Reacher-v5", 1, 5);
    let spec = envs.spec();
    assert_eq!((spec.observation_len, spec.action_len, spec.episode_steps), (10, 2, 50));
    assert_eq!(
        (spec.action_low.as_slice(), spec.action_high.as_slice()),
        (&[-1.0; 2][..], &[1.0; 2][..])
    );
    assert_eq!((spec.id.as_str(), spec.control_dt_s), ("Reacher-v5", 0.02));
    assert_eq!(spec.observation_name(9), "fingertip_to_target_y");
    let spec = started("tiny_envs:Goal-v0", 1, 5).spec().clone();
    assert_eq!(spec.observation_names[2..], ["observation[0]", "observation[1]"]);
    assert_eq!(spec.observation_name(0), "desired_goal[0]");
}

#[test]
fn what_the_list_of_tasks_says_is_what_the_environments_are() {
    for task in &TASKS {
        let config = TaskConfig::with_id(task.id);
        let envs = PythonEnvironments::start(interpreter(), &config, 1, 5).unwrap();
        let spec = envs.spec();
        assert_eq!(spec.id, task.id);
        assert_eq!(
            (spec.observation_len, spec.episode_steps),
            (task.observation_len, task.episode_steps),
            "{}",
            task.name
        );
        let bounds = (spec.action_low.as_slice(), spec.action_high.as_slice());
        assert_eq!(bounds, (task.action_low, task.action_high), "{}", task.name);
        assert!((spec.control_dt_s - task.control_dt_s).abs() < 1e-12, "{}", task.name);
    }
}

#[test]
fn same_seed_gives_the_same_observation() {
    let mut envs = started("Reacher-v5", 2, 5);
    let first = envs.next_observations().to_vec();
    assert_ne!(first[..10], first[10..]);
    envs.step_segment(&[0.5; 20]).unwrap();
    assert_ne!(envs.next_observations(), first);
    envs.reset(&[false, true], &[0, 8]).unwrap();
    assert_eq!(envs.next_observations()[10..], first[10..]);
    assert_ne!(envs.next_observations()[..10], first[..10]);
}

/// The reference is a plain Gymnasium loop in a separate Python, printed exactly.
#[test]
fn segments_equal_a_gymnasium_loop_over_two_episodes() {
    const LOOP: &str = "
import gymnasium, numpy as np
env = gymnasium.make('Reacher-v5')
observation, _ = env.reset(seed=7)
for step in range(105):
    action = [((index * 37) % 129) / 64 - 1 for index in (2 * step, 2 * step + 1)]
    observation, reward, terminated, truncated, _ = env.step(np.array(action, np.float32))
    print(float(reward).hex(), *(float(value).hex() for value in observation))
    if terminated or truncated:
        env.reset()";
    let output = Command::new(&venv().executable).args(["-c", LOOP]).output().unwrap();
    let expected = String::from_utf8(output.stdout).unwrap();
    let mut expected = expected.lines();

    let mut envs = started("Reacher-v5", 1, 5);
    for segment in 0..21 {
        let actions: Vec<f64> = (segment * 10..segment * 10 + 10).map(action_at).collect();
        envs.step_segment(&actions).unwrap();
        assert_eq!(envs.steps(), [5]);
        assert_eq!(envs.truncated(), [u8::from(segment % 10 == 9)]);
        for step in 0..5 {
            let row = &envs.observations()[(step + 1) * 10..(step + 2) * 10];
            let values = [&envs.rewards()[step..=step], row].concat();
            let wanted: Vec<u64> =
                expected.next().unwrap().split(' ').map(|hex| from_hex(hex).to_bits()).collect();
            assert_eq!(values.iter().map(|v| v.to_bits()).collect::<Vec<_>>(), wanted);
        }
    }
    assert_eq!(expected.next(), None);
}

/// Parses the output of Python's `float.hex()`.
fn from_hex(text: &str) -> f64 {
    let (sign, text) = text.strip_prefix('-').map_or((1.0, text), |rest| (-1.0, rest));
    let (digits, exponent) = text.strip_prefix("0x").unwrap().split_once('p').unwrap();
    let (whole, fraction) = digits.split_once('.').unwrap();
    let mantissa = u64::from_str_radix(&format!("{whole}{fraction}"), 16).unwrap() as f64;
    let exponent = exponent.parse::<i32>().unwrap() - 4 * fraction.len() as i32;
    sign * mantissa * 2f64.powi(exponent)
}

#[test]
fn episode_that_terminates_inside_a_segment_keeps_its_true_end() {
    let mut envs = started("tiny_envs:Countdown-v0", 2, 5);
    envs.step_segment(&[1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0]).unwrap();
    assert_eq!(envs.steps(), [3, 3]);
    assert_eq!((envs.terminated(), envs.truncated()), (&[1, 1][..], &[0, 0][..]));
    assert_eq!(envs.success(), [SUCCESS_YES, SUCCESS_NO]);
    assert_eq!(envs.rewards(), [1.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, -1.0, 0.0, 0.0]);
    let steps_observed: Vec<f64> = envs.observations().iter().step_by(2).copied().collect();
    assert_eq!(steps_observed, [[0.0, 1.0, 2.0, 3.0, 0.0, 0.0]; 2].concat());
    assert_eq!(envs.next_observations()[0], 0.0);
    assert_ne!(envs.next_observations()[1], envs.observations()[1]);
}

/// Environments in processes of their own, and in this one.
#[test]
fn vector_environments_give_the_same_segments_in_one_process_and_in_many() {
    let mut results = Vec::new();
    for name in ["sync", "in_processes"] {
        let mut envs = started(&format!("tiny_vectors:{name}"), 3, 5);
        let mut segments = Vec::new();
        for segment in 0..20 {
            let actions: Vec<f64> = (segment * 15..segment * 15 + 15).map(action_at).collect();
            envs.step_segment(&actions).unwrap();
            assert_eq!(envs.failed(), [0; 3]);
            segments.push((
                (envs.observations().to_vec(), envs.rewards().to_vec(), envs.steps().to_vec()),
                (envs.terminated().to_vec(), envs.truncated().to_vec(), envs.success().to_vec()),
                envs.next_observations().to_vec(),
            ));
        }
        results.push(segments);
    }
    assert_eq!(results[0], results[1]);
    let has_terminated = results[0].iter().any(|(_, (terminated, ..), _)| terminated.contains(&1));
    let was_truncated = results[0].iter().any(|(_, (_, truncated, _), _)| truncated.contains(&1));
    assert!(has_terminated && was_truncated);
}

/// The message names the place; the log has the traceback with the line of the environment's code.
#[test]
fn a_failed_environment_is_named_and_made_again_beside_the_others() {
    let mut envs = started("tiny_envs:Raises-v0", 3, 5);
    let mut actions = [0.0; 15];
    actions[5 + 3] = 2.0;
    envs.step_segment(&actions).unwrap();
    assert_eq!((envs.failed(), envs.steps()), (&[0, 1, 0][..], &[5, 0, 5][..]));
    let place = "tiny_envs:Raises-v0, environment 1, step 3 of the segment";
    assert_eq!(envs.take_failures().unwrap(), [format!("{place}: ValueError: the joint broke")]);
    assert_eq!(envs.take_failures().unwrap(), Vec::<String>::new());
    envs.step_segment(&[0.0; 15]).unwrap();
    assert_eq!((envs.failed(), envs.steps()), (&[0; 3][..], &[5; 3][..]));
}

#[test]
fn action_that_is_not_finite_is_refused_before_the_physics() {
    let mut envs = started("Reacher-v5", 2, 5);
    let mut actions = [0.0; 20];
    actions[10 + 2 * 3 + 1] = f64::NAN;
    let error = envs.step_segment(&actions).unwrap_err().to_string();
    assert_eq!(error, "Reacher-v5, environment 1, step 3 of the segment: action is NaN");
    let error = envs.step_segment(&[0.0; 10]).unwrap_err().to_string();
    assert_eq!(error, "Reacher-v5: actions has 10 entries, expected 20");
}

#[test]
fn unknown_id_gets_gymnasiums_suggestion() {
    let start = |id| refused(&TaskConfig::with_id(id));
    let error = start("Reachr-v5");
    assert!(error.contains("`Reachr`") && error.contains("Did you mean: `Reacher`"), "{error}");
    let error = start("nowhere:Task-v0");
    assert!(error.contains("no module 'nowhere'") && error.contains("--python-path"), "{error}");
    let error = start("CartPole-v1");
    assert!(error.contains("action space Discrete(2)") && error.contains("supported"), "{error}");
}

#[test]
fn arguments_and_wrappers_reach_the_environment() {
    let mut task = TaskConfig::with_id("tiny_envs:Countdown");
    task.kwargs = "length = 9\nmax_episode_steps = 4".parse().unwrap();
    task.wrappers = vec!["tiny_envs:doubled".into(), "tiny_envs:incremented".into()];
    let mut envs = PythonEnvironments::start(interpreter(), &task, 1, 5).unwrap();
    assert_eq!(envs.spec().episode_steps, 4);
    envs.reset(&[true], &[7]).unwrap();
    envs.step_segment(&[0.5; 5]).unwrap();
    assert_eq!((envs.steps(), envs.truncated(), envs.terminated()), (&[4][..], &[1][..], &[0][..]));
    assert_eq!(envs.rewards(), [2.0, 2.0, 2.0, 2.0, 0.0], "2 * 0.5 + 1");
}

#[test]
fn wrong_argument_gets_the_environments_own_message_and_a_remedy() {
    for (kwargs, message) in [
        ("lenght = 9", "Countdown.__init__() got an unexpected keyword argument 'lenght'"),
        ("length = -1", "ValueError: length is -1; expected 1 or more"),
    ] {
        let mut task = TaskConfig::with_id("tiny_envs:Countdown-v0");
        task.kwargs = kwargs.parse().unwrap();
        let error = refused(&task);
        assert!(error.contains(message), "{error}");
        assert!(error.contains("change task.kwargs (--env-kwargs)"), "{error}");
    }
    let mut task = TaskConfig::with_id("dmprl/PandaReach-v0");
    task.kwargs = "reward_type = 'sparse'".parse().unwrap();
    let error = refused(&task);
    let words = "dmprl/PandaReach-v0 has no argument reward_type; expected max_episode_steps";
    assert!(error.contains(words), "{error}");
}

#[test]
fn interpreter_is_isolated_and_in_the_venv() {
    let mut envs = started("tiny_envs:Interpreter", 1, 1);
    envs.step_segment(&[0.0]).unwrap();
    let other = InterpreterOptions { python_path: Vec::new(), ..options() };
    let error = Interpreter::start(&other).unwrap_err();
    assert!(matches!(error, PythonError::AlreadyStarted { .. }), "{error}");
    Interpreter::start(&options()).unwrap();
}
