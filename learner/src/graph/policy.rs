//! The policy as a graph of candle tensors: network, DMP, inverse controller and SAC's Gaussian.

use candle_core::{D, Device, Result, Tensor};
use dmprl_shared::config::{Controller, ExperimentConfig, ForcingScaling, RhoKind};
use dmprl_shared::dmp::{Dmp, SegmentMap};
use dmprl_shared::policy::{Head, MlpShape, Policy};

use super::batch::needed;
use crate::algorithms::action_penalties::UNSATURATED_MAX;
use crate::update::kernels::VARIANCE_EPSILON;

/// Range of a raw log-std, as in `dmprl_shared::policy::gaussian`.
const LOG_STD: (f64, f64) = (-20.0, 2.0);

/// The constants of a policy on the device.
#[derive(Debug)]
pub(super) struct PolicyGraph {
    shape: MlpShape,
    log_std_columns: Option<std::ops::Range<usize>>,
    dmp: Option<DmpGraph>,
}

#[derive(Debug)]
struct DmpGraph {
    /// Matrix of the segment map, (3 + N, 3K).
    matrix: Tensor,
    /// Centre of rho's range, (1, 0, 0, 0).
    rho_centre: Tensor,
    dims: usize,
    steps: usize,
    basis_count: usize,
    goal_range: f64,
    rho: RhoKind,
    rho_range: f64,
    forcing_scaling: ForcingScaling,
    controller: Controller,
    carries_state: bool,
}

/// A policy's decisions for a batch of states.
pub(super) struct Means {
    /// Means before tanh, (B, K A).
    pub means: Tensor,
    /// (y_K, yd_K / omega), (B, 2A), if the critic sees it.
    pub end_state: Option<Tensor>,
    /// The head's outputs that get a tanh, if they are not the means.
    squashed_outputs: Option<Tensor>,
    /// SAC's log-stds before clamping, (B, K A).
    raw_log_stds: Option<Tensor>,
}

/// A batch of states on the device.
#[derive(Debug)]
pub(super) struct DeviceStates {
    /// Network inputs, (B, O).
    pub inputs: Tensor,
    /// (y0, yd0) of every row and dimension, (B A, 2), for a DMP.
    pub starts: Option<Tensor>,
    /// Desired minus achieved goal in thresholds, (B, 1, G), for the outcome model.
    pub goal_distances: Option<Tensor>,
}

/// Computes a multilayer perceptron with its variables ([`Variable::of_mlp`]).
///
/// [`Variable::of_mlp`]: super::modules::Variable::of_mlp
pub(super) fn mlp(shape: &MlpShape, tensors: &[Tensor], inputs: &Tensor) -> Result<Tensor> {
    let layers = shape.layers().len();
    let (linear, normalised) = tensors.split_at(2 * layers);
    let mut x = inputs.clone();
    for (index, layer) in linear.chunks_exact(2).enumerate() {
        x = x.matmul(&layer[0].t()?)?.broadcast_add(&layer[1])?;
        if let Some([gain, shift]) = normalised.get(2 * index..2 * index + 2) {
            x = normalise(&x, gain, shift)?;
        }
        if index + 1 < layers {
            x = x.relu()?;
        }
    }
    Ok(x)
}

/// Normalises every row, then applies the layer's gain and shift.
pub(super) fn normalise(x: &Tensor, gain: &Tensor, shift: &Tensor) -> Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
    let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
    let std = (variance + f64::from(VARIANCE_EPSILON))?.sqrt()?;
    centred.broadcast_div(&std)?.broadcast_mul(gain)?.broadcast_add(shift)
}

impl PolicyGraph {
    pub(super) fn new(config: &ExperimentConfig, policy: &Policy, device: &Device) -> Result<Self> {
        let dmp = match policy.head() {
            Head::Mlp => None,
            Head::Dmp(_) => Some(DmpGraph::new(config, policy, device)?),
        };
        let log_std_columns = policy.log_stds();
        Ok(Self { shape: policy.shape().clone(), log_std_columns, dmp })
    }

    /// Computes the decisions of a network with these variables.
    pub(super) fn means(&self, tensors: &[Tensor], states: &DeviceStates) -> Result<Means> {
        let outputs = mlp(&self.shape, tensors, &states.inputs)?;
        let columns = self.log_std_columns.clone();
        let raw_log_stds = columns.map(|c| outputs.narrow(1, c.start, c.len())).transpose()?;
        let head_len = self.log_std_columns.as_ref().map_or(self.shape.outputs(), |c| c.start);
        let outputs = outputs.narrow(1, 0, head_len)?;
        let Some(dmp) = &self.dmp else {
            let (means, end_state, squashed_outputs) = (outputs, None, None);
            return Ok(Means { means, end_state, squashed_outputs, raw_log_stds });
        };
        let outputs = outputs.contiguous()?;
        let (means, end_state) = dmp.segment(&outputs, needed(&states.starts, "starts")?)?;
        let squashed_outputs = Some(dmp.squashed(&outputs)?);
        Ok(Means { means, end_state, squashed_outputs, raw_log_stds })
    }
}

impl DmpGraph {
    fn new(config: &ExperimentConfig, policy: &Policy, device: &Device) -> Result<Self> {
        let (dmp, steps) = (&config.dmp, policy.layout().segment_steps);
        let primitive = Dmp::new(dmp, steps).map_err(candle_core::Error::wrap)?;
        let weight_scale = config.policy.weight_range * primitive.omega() * primitive.omega();
        let map = SegmentMap::new(&primitive, weight_scale);
        let shape = (3 * steps, 3 + dmp.basis_count);
        Ok(Self {
            matrix: Tensor::from_slice(map.matrix(), shape, device)?.t()?.contiguous()?,
            rho_centre: Tensor::new(&[1.0_f32, 0.0, 0.0, 0.0], device)?,
            dims: policy.layout().action_len,
            steps,
            basis_count: dmp.basis_count,
            goal_range: config.policy.goal_range,
            rho: config.policy.rho,
            rho_range: config.policy.rho_range,
            forcing_scaling: dmp.forcing_scaling,
            controller: config.policy.controller,
            carries_state: policy.carries_dmp_state(),
        })
    }

    /// Returns those of the network's outputs, (B, A (1+N+4)), that get a tanh: (B, A, .).
    fn squashed(&self, outputs: &Tensor) -> Result<Tensor> {
        let cells = outputs.reshape((outputs.dim(0)?, self.dims, outputs.dim(1)? / self.dims))?;
        match self.rho {
            RhoKind::Bounded => Ok(cells),
            RhoKind::Free => cells.narrow(2, 0, 1 + self.basis_count),
        }
    }

    /// Computes means and end state from the network's outputs, (B, A (1+N+4)); without the
    /// inverse controller, (B, A (1+N)).
    fn segment(&self, outputs: &Tensor, starts: &Tensor) -> Result<(Tensor, Option<Tensor>)> {
        let (dims, k, n) = (self.dims, self.steps, self.basis_count);
        let rows = outputs.dim(0)?;
        let cells = outputs.reshape((rows * dims, outputs.dim(1)? / dims))?;
        let goal = (cells.narrow(1, 0, 1)?.tanh()? * self.goal_range)?;
        let mut weights = cells.narrow(1, 1, n)?.tanh()?;
        if self.forcing_scaling == ForcingScaling::Goal {
            weights = weights.broadcast_mul(&(&goal - starts.narrow(1, 0, 1)?)?)?;
        }
        let samples = Tensor::cat(&[starts, &goal, &weights], 1)?.matmul(&self.matrix)?;
        let v = match self.controller {
            Controller::Inverse => self.control(&cells.narrow(1, n + 1, 4)?, &samples)?,
            Controller::Direct => samples.narrow(1, 0, k)?,
            Controller::Position => candle_core::bail!("a graph has no position controller"),
        };
        let means = v.reshape((rows, dims, k))?.transpose(1, 2)?.reshape((rows, k * dims))?;
        if !self.carries_state {
            return Ok((means, None));
        }
        let end = |at: usize| samples.narrow(1, at, 1)?.reshape((rows, dims));
        Ok((means, Some(Tensor::cat(&[&end(k - 1)?, &end(2 * k - 1)?], 1)?)))
    }

    /// Computes the inverse controller's output before tanh, (B A, K), from the outputs for rho,
    /// (B A, 4), and the samples.
    fn control(&self, rho: &Tensor, samples: &Tensor) -> Result<Tensor> {
        let rho = match self.rho {
            RhoKind::Bounded => (rho.tanh()? * self.rho_range)?,
            RhoKind::Free => rho.clone(),
        };
        let rho = rho.broadcast_add(&self.rho_centre)?;
        let mut v = rho.narrow(1, 3, 1)?.broadcast_as((rho.dim(0)?, self.steps))?;
        for part in 0..3 {
            let sample = samples.narrow(1, part * self.steps, self.steps)?;
            v = (v + sample.broadcast_mul(&rho.narrow(1, part, 1)?)?)?;
        }
        Ok(v)
    }
}

impl Means {
    /// Returns u, (B, K A) in [-1, 1], followed by the end state if the critic sees it.
    pub(super) fn with_end_state(&self, u: &Tensor) -> Result<Tensor> {
        match &self.end_state {
            Some(end) => Tensor::cat(&[u, end], 1),
            None => Ok(u.clone()),
        }
    }

    /// Returns the penalty on saturation: the sum of max(|x| - 2, 0)² over all numbers before a
    /// tanh, as a mean over the batch.
    pub(super) fn saturation(&self) -> Result<Tensor> {
        let excess = |x: &Tensor| -> Result<Tensor> {
            let excess = (x.abs()? - f64::from(UNSATURATED_MAX))?.relu()?;
            excess.sqr()?.flatten_from(1)?.sum(1)?.mean_all()
        };
        let sum = excess(&self.means)?;
        match &self.squashed_outputs {
            Some(outputs) => sum + excess(outputs)?,
            None => Ok(sum),
        }
    }

    /// Draws u of SAC's Gaussian with standard normal `noise`, (B, K A). Returns u and its log
    /// density, (B, 1).
    pub(super) fn draw(&self, noise: &Tensor) -> Result<(Tensor, Tensor)> {
        let Some(raw) = &self.raw_log_stds else {
            candle_core::bail!("the policy has no distribution to draw from");
        };
        let log_std = raw.clamp(LOG_STD.0, LOG_STD.1)?;
        let x = (&self.means + (log_std.exp()? * noise)?)?;
        let normal = ((noise.sqr()? + (2.0 * std::f64::consts::PI).ln())? * -0.5)?;
        // log(1 - u²) as 2 (log 2 - x - softplus(-2x)).
        let y = (&x * -2.0)?;
        let softplus = (y.relu()? + (y.abs()?.neg()?.exp()? + 1.0)?.log()?)?;
        let log_slope = ((((x.neg()? - softplus)?) + 2.0_f64.ln())? * 2.0)?;
        let density = ((normal - log_std)? - log_slope)?;
        Ok((x.tanh()?, density.sum_keepdim(1)?))
    }
}
