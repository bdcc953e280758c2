//! Stages 3 and 6 of 8: policies, which map an observation to the actions of a segment.
//!
//! Rollout, evaluation and update use the same forward pass.
//!
//! ```text
//!   observation ── network ──► outputs ── tanh, ranges ──► goal, weights, rho   (per dimension)
//!                                                            │ DMP: one affine map
//!                                                            ▼
//!                              actions u in [-1, 1] ◄── inverse controller ◄── y, yd, ydd
//! ```
//! `network` is the multilayer perceptron. `dmp_head` is the rest of the `dmp` policy. The policies
//! `mlp` and `chunk` are the network followed by a tanh. All code works on flat `f32` slices and on
//! buffers that are allocated once.

mod action_scaling;
mod architecture;
mod command_state;
mod description;
mod dmp_head;
pub mod gaussian;
mod hold;
mod learned_std;
mod matrix;
mod network;
mod plan;
mod start;
mod tanh;

use std::ops::Range;

use rand_xoshiro::Xoshiro256PlusPlus;
use thiserror::Error;

pub use action_scaling::ActionScaling;
pub use command_state::CommandState;
pub use description::PolicyDescription;
pub use dmp_head::{DmpHead, DmpWorkspace, HeadGradient, Primitives};
pub use hold::{Hold, HoldError};
pub use learned_std::LearnedStd;
pub use matrix::{Keep, Matrix, product};
pub use network::{Activations, Layer, MlpShape, SmallBatchNetwork, forward, initial_parameters};
pub use plan::Plan;
pub use start::check_start_sources;
pub use tanh::tanh;

use crate::config::{Controller, PolicyKind, RangeError};
use crate::dmp::DmpError;
use crate::segment_layout::{ActionBounds, SegmentLayout};
use crate::spec::SpecError;

/// Why a policy cannot be built.
#[derive(Debug, Error)]
pub enum PolicyError {
    /// The environment's spec is invalid.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The DMP's configuration is invalid.
    #[error(transparent)]
    Dmp(#[from] DmpError),
    /// A value of a policy description is out of range.
    #[error(transparent)]
    Range(#[from] RangeError),
    /// `task.start_sources` does not fit the environment.
    #[error("task.start_sources: {0}")]
    StartSources(String),
    /// Wrong number of parameters.
    #[error("policy takes {expected} parameters, got {got}")]
    Length {
        /// Expected number.
        expected: usize,
        /// Actual number.
        got: usize,
    },
}

/// The part of a policy that maps the network's outputs to actions.
#[derive(Debug)]
pub enum Head {
    /// No movement primitive: u = tanh(output), one action (`mlp`) or K (`chunk`).
    Mlp,
    /// A segment of actions from DMP and inverse-controller parameters.
    Dmp(Box<DmpHead>),
}

/// A policy without its parameters.
#[derive(Debug)]
pub struct Policy {
    shape: MlpShape,
    head: Head,
    /// Number of network outputs that the head reads. Log-stds may follow them.
    head_outputs: usize,
    layout: SegmentLayout,
    learned_std: Option<LearnedStd>,
    /// Whether u = tanh(mean). The position controller's means are actions already.
    squashes: bool,
    scaling: ActionScaling,
    env_observation_len: usize,
    command_state: Option<CommandState>,
    architecture_hash: u64,
    description: PolicyDescription,
}

/// Buffers of one forward pass over up to `rows_max` observations.
#[derive(Debug)]
pub struct PolicyWorkspace {
    /// The network's activations, kept for the backward pass.
    pub activations: Activations,
    /// Values from which u is computed, (rows, K, A): tanh⁻¹ of u, or u itself (see
    /// [`Policy::squashes`]).
    pub means: Vec<f32>,
    /// u, (rows, K, A).
    pub actions: Vec<f32>,
    /// Values that the head keeps for the backward pass.
    pub dmp: Option<DmpWorkspace>,
}

impl Policy {
    /// Builds the described policy. Checks every value, because the description may come from an
    /// untrusted file.
    ///
    /// # Errors
    /// If a value is out of range or does not fit the environment.
    pub fn new(mut description: PolicyDescription) -> Result<Self, PolicyError> {
        description.spec.check()?;
        description.policy.check(&description.dmp, description.algorithm)?;
        // A policy acts without knowing rewards.
        description.spec.goal_rule = None;
        let PolicyDescription { spec, algorithm, policy, .. } = &description;
        let steps = policy.decision_steps();
        let layout = SegmentLayout {
            segment_steps: steps,
            observation_len: spec.observation_len + policy.state_len(spec.action_len),
            action_len: spec.action_len,
        };
        let head = match policy.kind {
            PolicyKind::Mlp | PolicyKind::Chunk => Head::Mlp,
            PolicyKind::Dmp => Head::Dmp(Box::new(DmpHead::new(&description)?)),
        };
        let head_outputs = match &head {
            Head::Mlp => layout.actions_len(),
            Head::Dmp(head) => head.outputs_len(),
        };
        let log_stds = if algorithm.has_gaussian_policy() { layout.actions_len() } else { 0 };
        let mut widths = vec![layout.observation_len];
        widths.extend(&policy.hidden);
        widths.push(head_outputs + log_stds);
        Ok(Self {
            shape: MlpShape::new(widths),
            learned_std: LearnedStd::of(&description),
            squashes: policy.kind != PolicyKind::Dmp || policy.controller != Controller::Position,
            head,
            head_outputs,
            layout,
            scaling: ActionScaling::new(spec, policy.action_range),
            env_observation_len: spec.observation_len,
            command_state: policy.follows_actions().then(|| CommandState::new(steps)),
            architecture_hash: architecture::hash(&description),
            description,
        })
    }

    /// Hash of everything except the parameters that determines the policy's actions.
    #[must_use]
    pub fn architecture_hash(&self) -> u64 {
        self.architecture_hash
    }

    /// Description of the policy without its parameters.
    #[must_use]
    pub fn description(&self) -> &PolicyDescription {
        &self.description
    }

    /// Sizes of the segments that this policy produces.
    #[must_use]
    pub fn layout(&self) -> SegmentLayout {
        self.layout
    }

    /// The network's layers.
    #[must_use]
    pub fn shape(&self) -> &MlpShape {
        &self.shape
    }

    /// Number P of flat parameters: those of the network, then those of the action distribution.
    #[must_use]
    pub fn parameters_len(&self) -> usize {
        self.shape.parameters_len() + self.learned_std.as_ref().map_or(0, LearnedStd::len)
    }

    /// Learned, state-independent standard deviations of the action distribution, if it has any.
    #[must_use]
    pub fn learned_std(&self) -> Option<&LearnedStd> {
        self.learned_std.as_ref()
    }

    /// Whether u is tanh(mean) instead of the mean itself.
    #[must_use]
    pub fn squashes(&self) -> bool {
        self.squashes
    }

    /// Bounds of the actions in a segment.
    #[must_use]
    pub fn action_bounds(&self) -> ActionBounds {
        if self.learned_std.is_some() { ActionBounds::None } else { ActionBounds::Unit }
    }

    /// The part that maps the network's outputs to actions.
    #[must_use]
    pub fn head(&self) -> &Head {
        &self.head
    }

    /// Range of the raw log-stds, (K, A), in a row of the network's outputs; `None` unless the
    /// policy is SAC's Gaussian policy.
    #[must_use]
    pub fn log_stds(&self) -> Option<Range<usize>> {
        let outputs = self.head_outputs..self.shape.outputs();
        (!outputs.is_empty()).then_some(outputs)
    }

    /// Scaling of u to the environment's units.
    #[must_use]
    pub fn scaling(&self) -> &ActionScaling {
        &self.scaling
    }

    /// Length of the environment's part of an observation. The state of the DMP or of the commands
    /// follows it, if the policy has one.
    #[must_use]
    pub fn env_observation_len(&self) -> usize {
        self.env_observation_len
    }

    /// Length of the state (y, yd) that follows the environment's observation: 2A or 0.
    #[must_use]
    pub fn state_len(&self) -> usize {
        self.layout.observation_len - self.env_observation_len
    }

    /// How the state follows the actions, with `start = "action"`.
    #[must_use]
    pub fn command_state(&self) -> Option<&CommandState> {
        self.command_state.as_ref()
    }

    /// Whether the state is the DMP's own, which continues across segments. Then the critic also
    /// sees the state after the segment, which its actions do not determine.
    #[must_use]
    pub fn carries_dmp_state(&self) -> bool {
        self.state_len() > 0 && self.command_state.is_none()
    }

    /// Draws initial parameters. Learned standard deviations are 1.
    #[must_use]
    pub fn initial_parameters(&self, random: &mut Xoshiro256PlusPlus) -> Vec<f32> {
        let mut parameters = initial_parameters(&self.shape, random);
        parameters.resize(self.parameters_len(), 0.0);
        parameters
    }

    /// Allocates buffers for up to `rows_max` observations at a time.
    #[must_use]
    pub fn workspace(&self, rows_max: usize) -> PolicyWorkspace {
        PolicyWorkspace {
            activations: Activations::new(&self.shape, rows_max),
            means: vec![0.0; rows_max * self.layout.actions_len()],
            actions: vec![0.0; rows_max * self.layout.actions_len()],
            dmp: match &self.head {
                Head::Mlp => None,
                Head::Dmp(head) => Some(head.workspace(rows_max)),
            },
        }
    }

    /// Computes u for every observation into `work.actions`. For a stochastic policy u is computed
    /// from the mean. With the position controller u is not bounded.
    ///
    /// - `parameters`: (P,). `observations`: (rows, O).
    ///
    /// # Panics
    /// If a length is wrong, or if there are more observations than the workspace has rows.
    pub fn act(&self, parameters: &[f32], observations: &[f32], work: &mut PolicyWorkspace) {
        assert_eq!(parameters.len(), self.parameters_len(), "policy parameters");
        let network = &parameters[..self.shape.parameters_len()];
        forward(&self.shape, network, observations, &mut work.activations);
        self.decode(observations, work);
    }

    /// Computes u from the network's outputs in `work.activations`, to which exploration may have
    /// added noise. This is the second half of [`Policy::act`].
    pub fn decode(&self, observations: &[f32], work: &mut PolicyWorkspace) {
        let rows = observations.len() / self.layout.observation_len;
        let (outputs, stride) = (work.activations.output(&self.shape, rows), self.shape.outputs());
        match (&self.head, &mut work.dmp) {
            (Head::Dmp(head), Some(dmp)) => {
                head.squash(outputs, stride, dmp);
                head.segment(observations, dmp, &mut work.means);
            }
            _ => {
                let len = self.layout.actions_len();
                let rows = outputs.chunks_exact(stride).zip(work.means.chunks_exact_mut(len));
                rows.for_each(|(outputs, means)| means.copy_from_slice(&outputs[..len]));
            }
        }
        self.bound_means(work, rows * self.layout.actions_len());
    }

    /// Computes u from the first `len` means.
    pub fn bound_means(&self, work: &mut PolicyWorkspace, len: usize) {
        work.actions[..len].copy_from_slice(&work.means[..len]);
        if self.squashes {
            tanh(&mut work.actions[..len]);
        }
    }
}
