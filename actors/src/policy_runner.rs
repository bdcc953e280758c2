//! Stage 3 of 8, decisions: runs a policy for E environments. Called by the rollout and the
//! evaluator.

use dmprl_shared::policy::{Head, LearnedStd, Plan, Policy, PolicyWorkspace, SmallBatchNetwork};

use crate::python_env::PythonEnvironments;

/// A policy for E environments and the state of their DMPs. All buffers are allocated once.
#[derive(Debug)]
pub struct PolicyRunner {
    /// The policy's architecture.
    pub policy: Policy,
    network: SmallBatchNetwork,
    /// Buffers of the forward pass.
    pub work: PolicyWorkspace,
    /// Current observations, (E, O).
    pub observations: Vec<f32>,
    /// Actions u to execute, with exploration, (E, S, A). They are in [-1, 1], unless they are
    /// draws of a policy with an unbounded Gaussian.
    pub u: Vec<f32>,
    /// Steps S that follow a decision: K, or 1 for an ensemble.
    steps: usize,
    /// Each environment's plan, (E,); empty unless the policy is executed as an ensemble.
    plans: Vec<Plan>,
    /// Learned standard deviations of the policy, (A,); empty if they are not learned.
    pub std: Vec<f32>,
    /// (y, yd) at the start of each environment's segment, (E, 2A); empty if the policy has no
    /// such state.
    state: Vec<f32>,
    /// `u` in the environments' units, (E, S, A).
    actions: Vec<f64>,
}

impl PolicyRunner {
    /// Creates a runner for `envs` environments that executes whole segments, without parameters.
    #[must_use]
    pub fn new(policy: Policy, envs: usize) -> Self {
        let steps = policy.layout().segment_steps;
        Self::with_plans(policy, envs, steps, Vec::new())
    }

    /// Creates a runner that executes segments as `policy.execution` states.
    #[must_use]
    pub fn without_exploration(policy: Policy, envs: usize) -> Self {
        let (layout, config) = (policy.layout(), &policy.description().policy);
        let steps = config.execution_steps();
        let plans = vec![Plan::new(layout); if config.is_ensemble() { envs } else { 0 }];
        Self::with_plans(policy, envs, steps, plans)
    }

    fn with_plans(policy: Policy, envs: usize, steps: usize, plans: Vec<Plan>) -> Self {
        let layout = policy.layout();
        let actions_len = envs * steps * layout.action_len;
        Self {
            network: SmallBatchNetwork::new(policy.shape().clone()),
            work: policy.workspace(envs),
            observations: vec![0.0; envs * layout.observation_len],
            u: vec![0.0; actions_len],
            std: vec![0.0; policy.learned_std().map_or(0, LearnedStd::len)],
            state: vec![0.0; envs * policy.state_len()],
            actions: vec![0.0; actions_len],
            steps,
            plans,
            policy,
        }
    }

    /// Steps S that follow a decision: K, or 1 if each environment has a plan.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Copies the observations from the environments, in 32 bits.
    pub fn observe(&mut self, environments: &PythonEnvironments) {
        let env_len = self.policy.env_observation_len();
        let len = self.policy.layout().observation_len;
        let rows = environments.next_observations().chunks_exact(env_len);
        for (env, (row, seen)) in rows.zip(self.observations.chunks_exact_mut(len)).enumerate() {
            for (seen, value) in seen.iter_mut().zip(row) {
                *seen = *value as f32;
            }
            let state_len = len - env_len;
            seen[env_len..].copy_from_slice(&self.state[env * state_len..(env + 1) * state_len]);
        }
    }

    /// Loads the policy's parameters.
    pub fn take_policy(&mut self, parameters: &[f32]) {
        self.network.load(&parameters[..self.policy.shape().parameters_len()]);
        if let Some(gaussian) = self.policy.learned_std() {
            for (std, log_std) in self.std.iter_mut().zip(gaussian.log_std(parameters)) {
                *std = log_std.exp();
            }
        }
    }

    /// Runs the network; the outputs are in `work.activations`.
    pub fn run_network(&mut self) {
        self.network.forward(&self.observations, &mut self.work.activations);
    }

    /// Converts the network's outputs to `u`, without exploration.
    pub fn decode(&mut self) {
        self.policy.decode(&self.observations, &mut self.work);
        self.take_u();
    }

    /// Copies the actions to `u`, clipped to [-1, 1]: the mean of a Gaussian may be outside. For an
    /// ensemble they go through the plans.
    fn take_u(&mut self) {
        if self.plans.is_empty() {
            for (u, action) in self.u.iter_mut().zip(&self.work.actions) {
                *u = action.clamp(-1.0, 1.0);
            }
            return;
        }
        let layout = self.policy.layout();
        let segments = self.work.actions.chunks_exact(layout.actions_len());
        let rows = self.u.chunks_exact_mut(layout.action_len);
        for ((plan, segment), u) in self.plans.iter_mut().zip(segments).zip(rows) {
            plan.add(segment);
            u.copy_from_slice(plan.take().expect("a segment has been added"));
        }
    }

    /// Converts squashed DMP parameters to `u`. `draw` fills the row of each environment, with
    /// A (1+N+4) entries.
    pub fn decode_drawn(&mut self, draw: &mut dyn FnMut(&mut [f32])) {
        if let (Head::Dmp(head), Some(dmp)) = (self.policy.head(), &mut self.work.dmp) {
            let rows = self.observations.len() / self.policy.layout().observation_len;
            (0..rows).for_each(|row| draw(head.squashed_mut(dmp, row)));
            head.segment(&self.observations, dmp, &mut self.work.means);
            self.policy.bound_means(&mut self.work, self.u.len());
            self.take_u();
        }
    }

    /// Returns `u` in the environments' units, (E, S, A).
    pub fn actions(&mut self) -> &[f64] {
        self.policy.scaling().apply(&self.u, &mut self.actions);
        &self.actions
    }

    /// Returns the result of the last call of [`Self::actions`].
    #[must_use]
    pub fn last_actions(&self) -> &[f64] {
        &self.actions
    }

    /// Advances `state`, (y, yd) of environment `env`, from after step `k` - 1 of the decision to
    /// after step `k`. Step 0 is its start. Does nothing if the policy has no state.
    pub fn advance_state(&self, env: usize, k: usize, state: &mut [f32]) {
        let layout = self.policy.layout();
        if let Some(commands) = self.policy.command_state() {
            if k == 0 {
                let len = state.len();
                state.copy_from_slice(&self.state[env * len..(env + 1) * len]);
            } else {
                let first = (env * self.steps + k - 1) * layout.action_len;
                commands.follow(&self.u[first..first + layout.action_len], state);
            }
        } else if self.policy.carries_dmp_state()
            && let (Head::Dmp(head), Some(dmp)) = (self.policy.head(), &self.work.dmp)
        {
            head.state_at(dmp, env, k, state);
        }
    }

    /// Sets the state from which environment `env`'s next segment starts: the one after the last
    /// step, or zero if the episode has ended. Then its plan is dropped, too.
    pub fn next_state(&mut self, env: usize, ended: bool) {
        if let Some(plan) = self.plans.get_mut(env).filter(|_| ended) {
            plan.clear();
        }
        let len = self.policy.state_len();
        if len == 0 {
            return;
        }
        let mut all = std::mem::take(&mut self.state);
        let state = &mut all[env * len..(env + 1) * len];
        if ended {
            state.fill(0.0);
        } else {
            for k in 1..=self.steps {
                self.advance_state(env, k, state);
            }
        }
        self.state = all;
    }
}
