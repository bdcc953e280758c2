//! Stage 8 of 8, evaluation: runs episodes with fixed seeds and without noise, in separate
//! environments. Called by the evaluator's loop.

use std::sync::atomic::{AtomicBool, Ordering};

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::policy::{Policy, PolicyError};

use crate::faults::Faults;
use crate::policy_runner::PolicyRunner;
use crate::python_env::{PythonEnvironments, SUCCESS_NOT_REPORTED, SUCCESS_YES};
use crate::rollout::RolloutError;
use crate::trace::Trace;

/// Steps after which an episode of an environment without a time limit is cut off.
const EPISODE_STEPS_MAX: u32 = 10_000;

/// Size of an action u from which it counts as at a bound.
const AT_BOUND: f32 = 0.99;

/// Maximum number of repeats of an episode, with the same seed, after a failure of its environment.
const EPISODE_REPEATS_MAX: u32 = 1;

/// Maximum number of environments that an evaluation runs in parallel. Each episode starts with a
/// reset with its own seed, so this number does not affect the result.
pub const ENVIRONMENTS_MAX: usize = 10;

/// Which episodes to run, and a flag that aborts them.
#[derive(Debug, Clone, Copy)]
pub struct Episodes<'a> {
    /// Number of episodes.
    pub count: usize,
    /// Episode i is reset with seed `first_seed + i`.
    pub first_seed: u64,
    /// Aborts the evaluation. Checked before each decision, because slow episodes take minutes.
    pub stop: &'a AtomicBool,
}

/// Result of a set of episodes.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    /// Sum of rewards of each episode, in the order of the seeds.
    pub returns: Vec<f64>,
    /// Fraction of episodes that reported success at their last step; `None` if the task does not
    /// report success.
    pub success_rate: Option<f64>,
    /// Mean |u_t - u_{t-1}| over all steps and action dimensions.
    pub smoothness: f64,
    /// Share of the actions u that are within 1 % of a bound, over all steps and dimensions.
    pub at_bounds: f64,
}

impl Evaluation {
    /// Returns the mean of the returns.
    #[must_use]
    pub fn return_mean(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len().max(1) as f64
    }
}

/// Runs evaluation episodes of policies of one architecture.
pub struct Evaluator {
    environments: PythonEnvironments,
    runner: PolicyRunner,
    faults: Faults,
    envs: usize,
    trace: Option<Trace>,
    /// Called after each decision's steps with the number of steps of the traced episode.
    on_steps: Box<dyn FnMut(usize)>,
}

/// Sums of episodes that run in parallel, one per environment.
struct Wave {
    returns: Vec<f64>,
    success: Vec<u8>,
    steps: Vec<u32>,
    running: Vec<bool>,
    seeds: Vec<u64>,
    failures: Vec<u32>,
    /// Last u of each environment, (E, A); NaN before the first step.
    last_u: Vec<f32>,
    /// Sum and number of the differences |u_t - u_{t-1}|.
    jumps: Vec<f64>,
    jump_count: Vec<u64>,
    /// Number of actions, per dimension, and of those at a bound.
    actions: Vec<u64>,
    at_bounds: Vec<u64>,
}

impl Evaluator {
    /// Creates an evaluator for `envs` environments.
    ///
    /// # Errors
    /// If the policy does not fit the environments.
    pub fn new(
        config: &ExperimentConfig,
        environments: PythonEnvironments,
        envs: usize,
    ) -> Result<Self, PolicyError> {
        let policy = Policy::new(config.policy_description(environments.spec()))?;
        // The number of repeats of an episode has its own limit.
        let faults = Faults::new(envs, u32::MAX);
        Ok(Self {
            environments,
            runner: PolicyRunner::without_exploration(policy, envs),
            faults,
            envs,
            trace: None,
            on_steps: Box::new(|_| ()),
        })
    }

    /// Creates an evaluator for a single environment that records each step of an episode.
    /// `on_steps` is called after each decision's steps with the number of steps so far.
    ///
    /// The network still processes as many rows as in an evaluation. With a single row, matrix
    /// products are rounded differently, and chaotic dynamics such as a bouncing ball amplify the
    /// difference.
    ///
    /// # Errors
    /// As [`Evaluator::new`].
    pub fn tracing(
        config: &ExperimentConfig,
        environment: PythonEnvironments,
        on_steps: Box<dyn FnMut(usize)>,
    ) -> Result<Self, PolicyError> {
        let rows = config.evaluation.episodes.clamp(1, ENVIRONMENTS_MAX);
        let evaluator = Self::new(config, environment, rows)?;
        let (faults, trace) = (Faults::new(1, u32::MAX), Some(Trace::default()));
        Ok(Self { envs: 1, faults, trace, on_steps, ..evaluator })
    }

    /// Returns the trace of the last episode and clears it; empty if this evaluator does not record
    /// traces.
    pub fn take_trace(&mut self) -> Trace {
        self.trace.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Returns the environments.
    #[must_use]
    pub fn environments(&self) -> &PythonEnvironments {
        &self.environments
    }

    /// Returns the policy's architecture.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        &self.runner.policy
    }

    /// Returns one line for each failure of an environment since the last call.
    pub fn take_failures(&mut self) -> Vec<String> {
        self.faults.take()
    }

    /// Runs the episodes; returns `None` if a stop was requested. If an environment fails, its
    /// episode is repeated once, with the same seed.
    ///
    /// # Errors
    /// `Episode` if an episode fails again; the next evaluation may succeed. Other errors are
    /// permanent.
    pub fn evaluate(
        &mut self,
        parameters: &[f32],
        episodes: Episodes<'_>,
    ) -> Result<Option<Evaluation>, RolloutError> {
        self.runner.take_policy(parameters);
        let mut returns = Vec::with_capacity(episodes.count);
        let mut success = Vec::with_capacity(episodes.count);
        let (mut jumps, mut jump_count) = (0.0, 0);
        let (mut actions, mut at_bounds) = (0, 0);
        while returns.len() < episodes.count {
            let count = (episodes.count - returns.len()).min(self.envs);
            let first_seed = episodes.first_seed + returns.len() as u64;
            let Some(wave) = self.wave(Episodes { count, first_seed, ..episodes })? else {
                return Ok(None);
            };
            returns.extend(&wave.returns[..count]);
            success.extend(&wave.success[..count]);
            jumps += wave.jumps.iter().sum::<f64>();
            jump_count += wave.jump_count.iter().sum::<u64>();
            actions += wave.actions.iter().sum::<u64>();
            at_bounds += wave.at_bounds.iter().sum::<u64>();
        }
        let reported = success.iter().all(|&flag: &u8| flag != SUCCESS_NOT_REPORTED);
        let successes = success.iter().filter(|&&flag| flag == SUCCESS_YES).count();
        Ok(Some(Evaluation {
            success_rate: reported.then(|| successes as f64 / success.len() as f64),
            smoothness: jumps / (jump_count.max(1) as f64),
            at_bounds: at_bounds as f64 / actions.max(1) as f64,
            returns,
        }))
    }

    /// Runs up to E episodes in parallel; returns `None` if a stop was requested.
    fn wave(
        &mut self,
        Episodes { count, first_seed, stop }: Episodes<'_>,
    ) -> Result<Option<Wave>, RolloutError> {
        let dims = self.runner.policy.layout().action_len;
        let actions_len = self.envs * self.runner.steps() * dims;
        let mut wave = Wave {
            returns: vec![0.0; self.envs],
            success: vec![SUCCESS_NOT_REPORTED; self.envs],
            steps: vec![0; self.envs],
            running: (0..self.envs).map(|env| env < count).collect(),
            seeds: (0..self.envs as u64).map(|env| first_seed + env).collect(),
            failures: vec![0; self.envs],
            last_u: vec![f32::NAN; self.envs * dims],
            jumps: vec![0.0; self.envs],
            jump_count: vec![0; self.envs],
            actions: vec![0; self.envs],
            at_bounds: vec![0; self.envs],
        };
        drop(self.take_trace());
        let all = vec![true; self.envs];
        self.environments.reset(&all, &wave.seeds)?;
        self.faults.inspect_reset(&mut self.environments, &all)?;
        (0..self.envs).for_each(|env| self.runner.next_state(env, true));
        while wave.running.iter().any(|&running| running) {
            if stop.load(Ordering::Acquire) {
                return Ok(None);
            }
            self.runner.observe(&self.environments);
            self.runner.run_network();
            self.runner.decode();
            self.environments.step_segment(&self.runner.actions()[..actions_len])?;
            let failed = self.faults.inspect_segment(&mut self.environments)?;
            for env in 0..self.envs {
                if wave.running[env] && !self.faults.failed()[env] {
                    self.add_steps(&mut wave, env);
                }
            }
            if failed {
                self.restart_episodes(&mut wave)?;
            }
        }
        Ok(Some(wave))
    }

    /// Restarts the episodes of failed environments. A failed environment whose episode is complete
    /// is also reset, because all environments are stepped together.
    fn restart_episodes(&mut self, wave: &mut Wave) -> Result<(), RolloutError> {
        let dims = self.runner.policy.layout().action_len;
        let mask = self.faults.failed().to_vec();
        for env in (0..self.envs).filter(|&env| mask[env]) {
            self.runner.next_state(env, true);
            if !wave.running[env] {
                continue;
            }
            wave.failures[env] += 1;
            if wave.failures[env] > EPISODE_REPEATS_MAX {
                let (seed, count) = (wave.seeds[env], wave.failures[env]);
                let cause = self.faults.cause(env).to_owned();
                return Err(RolloutError::Episode { seed, count, cause });
            }
            (wave.returns[env], wave.steps[env]) = (0.0, 0);
            (wave.jumps[env], wave.jump_count[env]) = (0.0, 0);
            (wave.actions[env], wave.at_bounds[env]) = (0, 0);
            wave.last_u[env * dims..(env + 1) * dims].fill(f32::NAN);
            drop(self.take_trace());
        }
        self.environments.reset(&mask, &wave.seeds)?;
        Ok(self.faults.inspect_reset(&mut self.environments, &mask)?)
    }

    /// Adds the steps that environment `env` has executed to the sums.
    fn add_steps(&mut self, wave: &mut Wave, env: usize) {
        let (k_max, dims) = (self.runner.steps(), self.runner.policy.layout().action_len);
        let steps = self.environments.steps()[env] as usize;
        let rewards = &self.environments.rewards()[env * k_max..][..steps];
        wave.returns[env] += rewards.iter().sum::<f64>();
        let u = &self.runner.u[env * k_max * dims..][..steps * dims];
        if let Some(trace) = &mut self.trace {
            trace.add_steps(&self.environments, &self.runner);
            (self.on_steps)(trace.rewards.len());
        }
        wave.actions[env] += u.len() as u64;
        wave.at_bounds[env] += u.iter().filter(|u| u.abs() >= AT_BOUND).count() as u64;
        let last = &mut wave.last_u[env * dims..(env + 1) * dims];
        for step in u.chunks_exact(dims) {
            for (u, last) in step.iter().zip(last.iter_mut()) {
                if last.is_finite() {
                    wave.jumps[env] += f64::from((u - *last).abs());
                    wave.jump_count[env] += 1;
                }
                *last = *u;
            }
        }
        wave.steps[env] += steps as u32;
        wave.success[env] = self.environments.success()[env];
        let ended =
            self.environments.terminated()[env] == 1 || self.environments.truncated()[env] == 1;
        self.runner.next_state(env, ended);
        wave.running[env] = !ended && wave.steps[env] < EPISODE_STEPS_MAX;
    }
}
