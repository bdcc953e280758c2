//! Stage 3 of 8, the rollout: observes, decides a segment, steps the environments and delivers.
//!
//! Called by the worker's loop. A segment takes one call into Python for all E environments; the
//! rest is Rust on buffers that are allocated once.

use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::{Policy, PolicyError};
use dmprl_shared::seeds;
use dmprl_shared::segment::{
    LAYOUT_VERSION, SUCCESS, SUCCESS_REPORTED, Segment, SegmentHeader, TERMINATED, TRUNCATED,
    block_checksum,
};
use thiserror::Error;

use crate::exploration::Exploration;
use crate::faults::{FailureBudgetExceeded, Faults};
use crate::goal_switching::GoalSwitching;
use crate::hindsight::{EpisodeSegment, Hindsight};
use crate::policy_runner::PolicyRunner;
use crate::python_env::{PythonEnvironments, PythonError, SUCCESS_NOT_REPORTED, SUCCESS_YES};

/// Why a rollout stopped.
#[derive(Debug, Error)]
pub enum RolloutError {
    /// The policy does not fit the environment.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The environments failed permanently.
    #[error(transparent)]
    Python(#[from] PythonError),
    /// One environment has failed more often than `actors.env_failures_max`.
    #[error(
        "environment {env_index} has failed {count} times without completing an episode, more \
         than actors.env_failures_max allows; last failure: {cause}"
    )]
    FailureBudgetExceeded {
        /// Index of the environment in the worker.
        env_index: usize,
        /// Failures since its last completed episode or its last thousand fault-free segments.
        count: u32,
        /// The last failure.
        cause: String,
    },
    /// An episode of an evaluation failed twice.
    #[error("the episode with seed {seed} has failed {count} times; last failure: {cause}")]
    Episode {
        /// Seed of its reset.
        seed: u64,
        /// Number of failures.
        count: u32,
        /// The last failure.
        cause: String,
    },
}

/// Accepts a finished segment and keeps it until the learner has acknowledged it.
pub type Deliver<'a, E> = &'a mut dyn FnMut(&SegmentHeader, &[f32]) -> Result<(), E>;

/// Identity of one start of a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Run id.
    pub run_id: u64,
    /// Slot of the worker.
    pub worker_id: u32,
    /// Number of the start of this slot, from 0.
    pub incarnation: u32,
    /// Index of the worker in the whole run, for its random numbers. It differs from `worker_id` on
    /// a host without a learner, whose slots are numbered from 0: no two workers may draw the same
    /// numbers.
    pub seed_index: u32,
}

impl Identity {
    /// Returns the number of this start's random streams, unique among all starts of a run's
    /// workers.
    #[must_use]
    pub fn stream(&self) -> u64 {
        u64::from(self.seed_index) << 32 | u64::from(self.incarnation)
    }
}

/// The part of a segment's header that describes its content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct SegmentMeta {
    /// Flags, as in the header.
    pub(crate) flags: u32,
    /// Version of the policy that acted.
    pub(crate) policy_version: u64,
    /// Number of steps of the episode before the segment.
    pub(crate) episode_step: u32,
    /// Number of steps, 1 to K.
    pub(crate) steps: usize,
}

#[derive(Debug, Clone, Copy, Default)]
struct Episode {
    number: u32,
    steps: u32,
}

/// A worker's environments, policy and exploration.
pub struct Rollout {
    identity: Identity,
    warm_up_steps: u64,
    environments: PythonEnvironments,
    runner: PolicyRunner,
    exploration: Exploration,
    goal_switching: Option<GoalSwitching>,
    episodes: Vec<Episode>,
    faults: Faults,
    hindsight: Option<Hindsight>,
    /// Seeds of the first reset and of the next reset after a failure, (E,).
    env_seeds: Vec<u64>,
    new_seeds: Vec<u64>,
    segment: Segment,
    sequence: u64,
    /// Version of the policy that `runner` has loaded.
    loaded_version: u64,
    /// The newest policy; version 0 until the first one arrives.
    pub snapshot: ParameterSnapshot,
}

impl Rollout {
    /// Creates the policy and resets the environments, each with its own seed.
    ///
    /// # Errors
    /// If the policy does not fit the environments, or a reset fails.
    pub fn start(
        config: &ExperimentConfig,
        mut environments: PythonEnvironments,
        identity: Identity,
    ) -> Result<Self, RolloutError> {
        let envs = config.actors.envs_per_worker;
        let policy = Policy::new(config.policy_description(environments.spec()))?;
        let layout = policy.layout();
        // A restarted worker starts new episodes, which must differ from its predecessor's.
        let worker = identity.stream();
        let random = seeds::stream(config.run.seed, "exploration", worker);
        let env_seeds = environment_seeds(config.run.seed, worker, envs);
        let mut faults = Faults::new(envs, config.actors.env_failures_max);
        let all = vec![true; envs];
        environments.reset(&all, &env_seeds)?;
        faults.inspect_reset(&mut environments, &all)?;
        let hindsight = Hindsight::start(config, &environments, layout, worker)?;
        let rule = environments.spec().goal_rule.as_deref();
        let goals = seeds::stream(config.run.seed, "goals", worker);
        Ok(Self {
            goal_switching: GoalSwitching::new(rule, config, goals),
            hindsight,
            identity,
            warm_up_steps: config.exploration.warm_up_steps,
            exploration: Exploration::new(
                config.exploration.clone(),
                random,
                envs,
                layout.action_len,
            ),
            episodes: vec![Episode::default(); envs],
            faults,
            new_seeds: env_seeds.clone(),
            env_seeds,
            segment: Segment::zeroed(layout),
            sequence: 0,
            loaded_version: 0,
            snapshot: ParameterSnapshot::default(),
            runner: PolicyRunner::new(policy, envs),
            environments,
        })
    }

    /// Returns the policy's architecture.
    #[must_use]
    pub fn policy(&self) -> &Policy {
        &self.runner.policy
    }

    /// Decides and runs one segment in every environment with `self.snapshot`, and passes each
    /// segment to `deliver`.
    ///
    /// A failed environment's segment is not delivered and uses no sequence number. Its next
    /// episode starts with the next call. [`Rollout::take_failures`] returns the failure.
    ///
    /// # Errors
    /// If an environment fails permanently or too often, and errors of `deliver`.
    pub fn segment<E: From<RolloutError>>(&mut self, deliver: Deliver<'_, E>) -> Result<(), E> {
        self.runner.observe(&self.environments);
        let warming_up = self.snapshot.version == 0 || self.snapshot.env_steps < self.warm_up_steps;
        if warming_up {
            self.exploration.warm_up(&mut self.runner);
        } else {
            if self.loaded_version != self.snapshot.version {
                self.runner.take_policy(&self.snapshot.values);
                self.loaded_version = self.snapshot.version;
            }
            if let Some(goals) = &mut self.goal_switching {
                goals.pursue(&mut self.runner.observations);
            }
            self.runner.run_network();
            self.exploration.explore(&mut self.runner, self.snapshot.settled);
        }
        let policy_version = if warming_up { 0 } else { self.snapshot.version };
        self.environments.step_segment(self.runner.actions()).map_err(RolloutError::from)?;
        let failed =
            self.faults.inspect_segment(&mut self.environments).map_err(RolloutError::from)?;
        for env in 0..self.episodes.len() {
            let mut ended = self.faults.failed()[env];
            if !ended {
                self.record(env, policy_version)?;
                deliver(&self.segment.header, &self.segment.block)?;
                ended = self.segment.header.flags & (TERMINATED | TRUNCATED) != 0;
            }
            if ended {
                self.deliver_copies(env, deliver)?;
                self.begin_episode(env);
            }
        }
        // Last, because the segments of the other environments are valid even if this fails.
        if failed { Ok(self.reset_failed()?) } else { Ok(()) }
    }

    /// Returns the maximum number of segments that one call of [`Rollout::segment`] delivers.
    #[must_use]
    pub fn segments_max(&self) -> usize {
        let copies = self.hindsight.as_ref().map_or(0, Hindsight::copies_max);
        self.episodes.len() * (1 + copies)
    }

    /// Delivers the hindsight copies of the episode of environment `env` that has ended.
    fn deliver_copies<E: From<RolloutError>>(
        &mut self,
        env: usize,
        deliver: Deliver<'_, E>,
    ) -> Result<(), E> {
        let Some(hindsight) = &mut self.hindsight else { return Ok(()) };
        let copies = hindsight.relabel(env).map_err(RolloutError::from)?;
        for index in 0..copies {
            let Some(hindsight) = &self.hindsight else { break };
            let copy = hindsight.write(env, index, &mut self.segment.block);
            let Some(meta) = copy else { continue };
            self.write_header(env, meta);
            deliver(&self.segment.header, &self.segment.block)?;
        }
        Ok(())
    }

    /// Returns one line for each failure of an environment since the last call.
    pub fn take_failures(&mut self) -> Vec<String> {
        self.faults.take()
    }

    /// Resets the failed environments that cannot continue.
    fn reset_failed(&mut self) -> Result<(), RolloutError> {
        if let Some(FailureBudgetExceeded { env_index, count, cause }) =
            self.faults.budget_exceeded()
        {
            return Err(RolloutError::FailureBudgetExceeded { env_index, count, cause });
        }
        if self.faults.needs_reset().contains(&true) {
            for (new, first) in self.new_seeds.iter_mut().zip(&self.env_seeds) {
                *new = seeds::derive(*first, "failure", self.faults.total()) >> 33;
            }
            let mask = self.faults.needs_reset().to_vec();
            self.environments.reset(&mask, &self.new_seeds)?;
            self.faults.inspect_reset(&mut self.environments, &mask)?;
        }
        Ok(())
    }

    fn begin_episode(&mut self, env: usize) {
        if let Some(hindsight) = &mut self.hindsight {
            hindsight.begin_episode(env);
        }
        self.runner.next_state(env, true);
        self.exploration.episode_ended(env);
        if let Some(goals) = &mut self.goal_switching {
            goals.episode_ended(env);
        }
        self.episodes[env] = Episode { number: self.episodes[env].number + 1, steps: 0 };
    }

    /// Fills `self.segment` with the last segment of environment `env`.
    fn record(&mut self, env: usize, policy_version: u64) -> Result<(), RolloutError> {
        let steps = self.environments.steps()[env] as usize;
        self.fill_block(env, steps);
        let flag = |set: bool, flag: u32| if set { flag } else { 0 };
        let flags = flag(self.environments.terminated()[env] == 1, TERMINATED)
            | flag(self.environments.truncated()[env] == 1, TRUNCATED)
            | flag(self.environments.success()[env] == SUCCESS_YES, SUCCESS)
            | flag(self.environments.success()[env] != SUCCESS_NOT_REPORTED, SUCCESS_REPORTED);
        let episode_step = self.episodes[env].steps;
        self.write_header(env, SegmentMeta { flags, policy_version, episode_step, steps });
        if let Some(hindsight) = &mut self.hindsight {
            let len = self.environments.observations().len() / self.episodes.len();
            let observations = &self.environments.observations()[env * len..(env + 1) * len];
            let block = self.segment.block.as_slice();
            hindsight.add(env, EpisodeSegment { steps, block, observations, policy_version })?;
        }
        if flags & (TERMINATED | TRUNCATED) != 0 {
            self.faults.completed(env);
        } else {
            self.runner.next_state(env, false);
            self.episodes[env].steps += steps as u32;
        }
        Ok(())
    }

    /// Writes the header of the segment whose block is complete.
    fn write_header(&mut self, env: usize, meta: SegmentMeta) {
        let layout = self.runner.policy.layout();
        self.sequence += 1;
        self.segment.header = SegmentHeader {
            layout_version: LAYOUT_VERSION,
            flags: meta.flags,
            run_id: self.identity.run_id,
            architecture_hash: self.runner.policy.architecture_hash(),
            policy_version: meta.policy_version,
            sequence: self.sequence,
            worker_id: self.identity.worker_id,
            incarnation: self.identity.incarnation,
            env_index: env as u32,
            episode: self.episodes[env].number,
            episode_step: meta.episode_step,
            steps_len: meta.steps as u32,
            segment_steps: layout.segment_steps as u32,
            observation_len: layout.observation_len as u32,
            action_len: layout.action_len as u32,
            checksum: block_checksum(&self.segment.block),
        };
    }

    fn fill_block(&mut self, env: usize, steps: usize) {
        let layout = self.runner.policy.layout();
        let (k_max, o, a) = (layout.segment_steps, layout.observation_len, layout.action_len);
        let env_len = self.runner.policy.env_observation_len();
        let (observations, actions, rewards) = layout.split_mut(&mut self.segment.block);
        let from = &self.environments.observations()[env * (k_max + 1) * env_len..];
        for k in 0..=steps {
            let (before, row) = observations[..(k + 1) * o].split_at_mut(k * o);
            if let Some(before) = before.rchunks_exact(o).next() {
                row[env_len..].copy_from_slice(&before[env_len..]);
            }
            for (out, value) in row.iter_mut().zip(&from[k * env_len..(k + 1) * env_len]) {
                *out = *value as f32;
            }
            self.runner.advance_state(env, k, &mut row[env_len..]);
        }
        observations[(steps + 1) * o..].fill(0.0);
        let u = &self.runner.u[env * k_max * a..(env + 1) * k_max * a];
        actions[..steps * a].copy_from_slice(&u[..steps * a]);
        actions[steps * a..].fill(0.0);
        let from = &self.environments.rewards()[env * k_max..];
        for (out, value) in rewards[..steps].iter_mut().zip(from) {
            *out = *value as f32;
        }
        rewards[steps..].fill(0.0);
    }
}

/// Derives a seed for each environment of a worker, of 31 bits because some environments accept no
/// more.
fn environment_seeds(master: u64, worker: u64, envs: usize) -> Vec<u64> {
    let seed = |env| seeds::derive(master, "environment", worker << 16 | env) >> 33;
    (0..envs as u64).map(seed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_differ_between_environments_workers_and_restarts() {
        let workers = (0..16_u64).flat_map(|id| (0..4).map(move |start| id << 32 | start));
        let all: Vec<u64> = workers.flat_map(|worker| environment_seeds(1, worker, 16)).collect();
        let distinct: std::collections::HashSet<_> = all.iter().collect();
        assert_eq!((all.len(), distinct.len()), (1024, 1024));
        assert_ne!(environment_seeds(1, 0, 16), environment_seeds(2, 0, 16));
    }
}
