//! Maps the network's outputs to a segment of actions, and propagates gradients back.
//!
//! The outputs of one action dimension are adjacent: goal, N weights, 4 rho. With t = tanh(output):
//! g = goal_range t, w = weight_range omega² t, and rho = (1, 0, 0, 0) + rho_range t. With
//! `rho = "free"`, rho = (1, 0, 0, 0) + output. Other controllers than `inverse` have no rho.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::start::StartState;
use super::{PolicyDescription, PolicyError, tanh};
use crate::config::{Controller, RhoKind};
use crate::dmp::{Dmp, SegmentMap, act, act_backward, act_position, act_position_backward};

/// Number of inverse-controller parameters per dimension.
const RHO_LEN: usize = 4;
const RHO_CENTRE: [f32; RHO_LEN] = [1.0, 0.0, 0.0, 0.0];

/// DMP and inverse controller with the ranges of their parameters.
#[derive(Debug)]
pub struct DmpHead {
    map: SegmentMap,
    start: StartState,
    observation_len: usize,
    dims: usize,
    steps: usize,
    basis_count: usize,
    goal_range: f32,
    controller: Controller,
    position_scale: f32,
    rho: RhoKind,
    rho_range: f32,
    weight_scale: f32,
    omega: f32,
}

/// Values that the forward pass keeps, per row and dimension.
#[derive(Debug)]
pub struct DmpWorkspace {
    /// tanh of goal and weight outputs, and tanh of (or the raw) rho outputs: (rows, A, 1+N+4).
    squashed: Vec<f32>,
    /// Inputs of the segment map: (rows, A, 3+N).
    inputs: Vec<f32>,
    /// y, yd/omega, ydd/omega² at the K samples: (rows, A, 3K).
    samples: Vec<f32>,
    scratch: Scratch,
}

#[derive(Debug)]
struct Scratch {
    means: Vec<f32>,
    means_gradient: Vec<f32>,
    samples_gradient: Vec<f32>,
    inputs_gradient: Vec<f32>,
}

/// The primitives of one row: A action dimensions, N basis functions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Primitives {
    /// Positions y0 from which the segment starts, (A,).
    pub start: Vec<f32>,
    /// Goals g, (A,).
    pub goal: Vec<f32>,
    /// Weights w \[u/s^2\], (A, N).
    pub weights: Vec<Vec<f32>>,
    /// Positions y after each step, (K, A).
    pub positions: Vec<Vec<f32>>,
}

/// Gradient that the head's backward pass starts from.
#[derive(Debug, Clone, Copy)]
pub struct HeadGradient<'a> {
    /// Gradient with respect to the means, before their tanh, (rows, K, A).
    pub means: &'a [f32],
    /// Gradient with respect to the end state (y_K (A,), yd_K/omega (A,)), (rows, 2A); empty: none.
    pub end_state: &'a [f32],
}

impl DmpHead {
    /// Creates the head of the described policy.
    ///
    /// # Errors
    /// If the DMP's configuration is invalid, or `task.start_sources` does not fit the environment.
    pub fn new(description: &PolicyDescription) -> Result<Self, PolicyError> {
        let PolicyDescription { spec, policy, .. } = description;
        let dmp = Dmp::new(&description.dmp, policy.segment_steps)?;
        let weight_scale = policy.weight_range * dmp.omega() * dmp.omega();
        Ok(Self {
            map: SegmentMap::new(&dmp, weight_scale),
            start: StartState::new(description)?,
            observation_len: spec.observation_len + policy.state_len(spec.action_len),
            dims: spec.action_len,
            steps: policy.segment_steps,
            basis_count: description.dmp.basis_count,
            goal_range: policy.goal_range as f32,
            controller: policy.controller,
            position_scale: policy.position_scale as f32,
            rho: policy.rho,
            rho_range: policy.rho_range as f32,
            weight_scale: weight_scale as f32,
            omega: dmp.omega() as f32,
        })
    }

    /// Number of network outputs that the head reads.
    #[must_use]
    pub fn outputs_len(&self) -> usize {
        self.dims * self.per_dimension()
    }

    /// Ranges of the outputs that get a tanh. Outputs for an unbounded rho do not.
    pub fn squashed_outputs(&self) -> impl Iterator<Item = Range<usize>> {
        let n = self.per_dimension();
        let len = if self.rho == RhoKind::Bounded { n } else { 1 + self.basis_count };
        (0..self.dims).map(move |d| d * n..d * n + len)
    }

    fn per_dimension(&self) -> usize {
        1 + self.basis_count
            + match self.controller {
                Controller::Inverse => RHO_LEN,
                Controller::Position | Controller::Direct => 0,
            }
    }

    fn inputs_len(&self) -> usize {
        3 + self.basis_count
    }

    /// Allocates buffers for up to `rows_max` rows.
    #[must_use]
    pub fn workspace(&self, rows_max: usize) -> DmpWorkspace {
        let cells = rows_max * self.dims;
        DmpWorkspace {
            squashed: vec![0.0; cells * self.per_dimension()],
            inputs: vec![0.0; cells * self.inputs_len()],
            samples: vec![0.0; cells * 3 * self.steps],
            scratch: Scratch {
                means: vec![0.0; self.steps],
                means_gradient: vec![0.0; self.steps],
                samples_gradient: vec![0.0; 3 * self.steps],
                inputs_gradient: vec![0.0; self.inputs_len()],
            },
        }
    }

    /// Squashes the network's outputs. The head's A (1+N+4) outputs are the first of each row of
    /// length `stride`.
    pub fn squash(&self, outputs: &[f32], stride: usize, work: &mut DmpWorkspace) {
        let (n, len) = (self.per_dimension(), self.outputs_len());
        let rows = outputs.len() / stride;
        let squashed = &mut work.squashed[..rows * len];
        let pairs = outputs.chunks_exact(stride).zip(squashed.chunks_exact_mut(len));
        pairs.for_each(|(outputs, squashed)| squashed.copy_from_slice(&outputs[..len]));
        tanh(squashed);
        if self.rho != RhoKind::Bounded {
            let bounded = 1 + self.basis_count;
            let pairs = outputs.chunks_exact(stride).zip(squashed.chunks_exact_mut(len));
            for (outputs, squashed) in pairs {
                let dims = outputs[..len].chunks_exact(n).zip(squashed.chunks_exact_mut(n));
                dims.for_each(|(out, kept)| kept[bounded..].copy_from_slice(&out[bounded..]));
            }
        }
    }

    /// Returns the squashed parameters of row `row`, (A (1+N+4)), so that the warm-up can replace
    /// them by random ones.
    pub fn squashed_mut<'a>(&self, work: &'a mut DmpWorkspace, row: usize) -> &'a mut [f32] {
        let len = self.outputs_len();
        &mut work.squashed[row * len..(row + 1) * len]
    }

    /// Computes the means of the segments' actions before tanh, (rows, K, A), from the squashed
    /// parameters and the observations, (rows, O).
    pub fn segment(&self, observations: &[f32], work: &mut DmpWorkspace, means: &mut [f32]) {
        let (dims, steps) = (self.dims, self.steps);
        let (n, inputs_len) = (self.per_dimension(), self.inputs_len());
        let DmpWorkspace { squashed, inputs, samples, scratch } = work;
        for (row, observation) in observations.chunks_exact(self.observation_len).enumerate() {
            let means = &mut means[row * steps * dims..(row + 1) * steps * dims];
            for d in 0..dims {
                let cell = row * dims + d;
                let squashed = &squashed[cell * n..(cell + 1) * n];
                let inputs = &mut inputs[cell * inputs_len..(cell + 1) * inputs_len];
                let samples = &mut samples[cell * 3 * steps..(cell + 1) * 3 * steps];
                (inputs[0], inputs[1]) = self.start.read(observation, d, dims);
                inputs[2] = self.goal_range * squashed[0];
                inputs[3..].copy_from_slice(&squashed[1..=self.basis_count]);
                self.map.forward(inputs, samples);
                match self.controller {
                    Controller::Inverse => act(samples, &self.rho(squashed), &mut scratch.means),
                    Controller::Position => {
                        act_position(inputs[0], samples, self.position_scale, &mut scratch.means);
                    }
                    Controller::Direct => scratch.means.copy_from_slice(&samples[..steps]),
                }
                for (k, mean) in scratch.means.iter().enumerate() {
                    means[k * dims + d] = *mean;
                }
            }
        }
    }

    /// Reads (y0, yd0) of every row of observations, (rows, O), and dimension: (rows A, 2).
    #[must_use]
    pub fn starts(&self, observations: &[f32]) -> Vec<f32> {
        let rows = observations.chunks_exact(self.observation_len);
        let of_row = |row| (0..self.dims).map(move |d| self.start.read(row, d, self.dims));
        rows.flat_map(of_row).flat_map(|(y, yd)| [y, yd]).collect()
    }

    fn rho(&self, squashed: &[f32]) -> [f32; RHO_LEN] {
        let range = self.rho_factor();
        std::array::from_fn(|i| RHO_CENTRE[i] + range * squashed[1 + self.basis_count + i])
    }

    fn rho_factor(&self) -> f32 {
        if self.rho == RhoKind::Bounded { self.rho_range } else { 1.0 }
    }

    /// Writes (y, yd) of row `row` after step `k` (0: the start) into `state`: y (A,), then yd
    /// (A,).
    pub fn state_at(&self, work: &DmpWorkspace, row: usize, k: usize, state: &mut [f32]) {
        for d in 0..self.dims {
            let cell = row * self.dims + d;
            let inputs = &work.inputs[cell * self.inputs_len()..];
            let samples = &work.samples[cell * 3 * self.steps..];
            (state[d], state[self.dims + d]) = match k {
                0 => (inputs[0], inputs[1]),
                _ => (samples[k - 1], samples[self.steps + k - 1] * self.omega),
            };
        }
    }

    /// Returns the primitives of row `row`, as the last segment used them.
    #[must_use]
    pub fn primitives(&self, work: &DmpWorkspace, row: usize) -> Primitives {
        let cells = row * self.dims..(row + 1) * self.dims;
        let inputs = |cell: usize| &work.inputs[cell * self.inputs_len()..][..self.inputs_len()];
        let weights = |cell| inputs(cell)[3..].iter().map(|w| self.weight_scale * w).collect();
        let position = |cell: usize, k: usize| work.samples[cell * 3 * self.steps + k];
        let positions = |k| cells.clone().map(|cell| position(cell, k)).collect();
        Primitives {
            start: cells.clone().map(|cell| inputs(cell)[0]).collect(),
            goal: cells.clone().map(|cell| inputs(cell)[2]).collect(),
            weights: cells.clone().map(weights).collect(),
            positions: (0..self.steps).map(positions).collect(),
        }
    }

    /// Writes (y_K (A,), yd_K/omega (A,)) of every row, the critic's input, into rows of `out` that
    /// are `stride` apart.
    pub fn end_states(&self, work: &DmpWorkspace, out: &mut [f32], stride: usize) {
        for (row, out) in out.chunks_mut(stride).enumerate() {
            self.state_at(work, row, self.steps, out);
            for velocity in &mut out[self.dims..2 * self.dims] {
                *velocity /= self.omega;
            }
        }
    }

    /// The map from (y0, yd0, g, w) to the samples of one dimension.
    #[must_use]
    pub fn map(&self) -> &SegmentMap {
        &self.map
    }

    /// omega = alpha_y / 2; the critic's end velocity is divided by it.
    #[must_use]
    pub fn omega(&self) -> f32 {
        self.omega
    }

    /// Computes the gradient with respect to the network's outputs. Overwrites the head's A (1+N+4)
    /// numbers at the start of each row of length `stride`.
    pub fn backward(
        &self,
        work: &mut DmpWorkspace,
        gradient: HeadGradient<'_>,
        outputs_gradient: &mut [f32],
        stride: usize,
    ) {
        let (dims, steps, n) = (self.dims, self.steps, self.per_dimension());
        let inputs_len = self.inputs_len();
        let DmpWorkspace { squashed, inputs, samples, scratch } = work;
        let rows = outputs_gradient.chunks_exact_mut(stride);
        let cells = rows.flat_map(|row| row[..dims * n].chunks_exact_mut(n));
        for (cell, out) in cells.enumerate() {
            let (row, d) = (cell / dims, cell % dims);
            let squashed = &squashed[cell * n..(cell + 1) * n];
            let inputs = &inputs[cell * inputs_len..(cell + 1) * inputs_len];
            let samples = &samples[cell * 3 * steps..(cell + 1) * 3 * steps];
            for k in 0..steps {
                let at = (row * steps + k) * dims + d;
                scratch.means_gradient[k] = gradient.means[at];
            }
            let rho_gradient = self.controller_backward(squashed, samples, scratch);
            if !gradient.end_state.is_empty() {
                let end = &gradient.end_state[row * 2 * dims..];
                scratch.samples_gradient[steps - 1] += end[d];
                scratch.samples_gradient[2 * steps - 1] += end[dims + d];
            }
            self.map.backward(inputs, &scratch.samples_gradient, &mut scratch.inputs_gradient);
            self.unsquash(squashed, &scratch.inputs_gradient, &rho_gradient, out);
        }
    }

    /// Computes the samples' gradient from the means' gradient, both in `scratch`. Returns rho's
    /// gradient.
    fn controller_backward(
        &self,
        squashed: &[f32],
        samples: &[f32],
        scratch: &mut Scratch,
    ) -> [f32; RHO_LEN] {
        let Scratch { means_gradient, samples_gradient, .. } = scratch;
        match self.controller {
            Controller::Inverse => {
                let rho = self.rho(squashed);
                act_backward(samples, &rho, means_gradient, samples_gradient)
            }
            Controller::Position => {
                // The start is not computed by the network, so its gradient is not needed.
                act_position_backward(self.position_scale, means_gradient, samples_gradient);
                [0.0; RHO_LEN]
            }
            Controller::Direct => {
                let (y, others) = samples_gradient.split_at_mut(self.steps);
                y.copy_from_slice(means_gradient);
                others.fill(0.0);
                [0.0; RHO_LEN]
            }
        }
    }

    fn unsquash(
        &self,
        squashed: &[f32],
        inputs_gradient: &[f32],
        rho_gradient: &[f32; RHO_LEN],
        out: &mut [f32],
    ) {
        let slope = |t: f32| 1.0 - t * t;
        out[0] = inputs_gradient[2] * self.goal_range * slope(squashed[0]);
        for i in 0..self.basis_count {
            out[1 + i] = inputs_gradient[3 + i] * slope(squashed[1 + i]);
        }
        if self.controller != Controller::Inverse {
            return;
        }
        for (i, gradient) in rho_gradient.iter().enumerate() {
            let at = 1 + self.basis_count + i;
            let slope = if self.rho == RhoKind::Bounded { slope(squashed[at]) } else { 1.0 };
            out[at] = gradient * self.rho_factor() * slope;
        }
    }
}

#[cfg(test)]
mod tests;
