//! Truncated quantile critics (Kuznetsov et al. 2020, "Controlling overestimation bias with
//! truncated mixture of continuous distributional quantile critics", Algorithm 1) over segments:
//! SAC whose critics predict quantiles of the return. The largest quantiles of all critics together
//! are left out of the target.
//!
//! Differences from Kuznetsov et al.:
//! 1. An action may be a segment of K actions with one entropy term, and the target is the K-step
//!    return, as in SAC (`algorithms::sac`). K = 1 is the published algorithm.
//! 2. Two critics instead of five, as in sb3-contrib, with the widths of `critic_hidden`.
//! 3. The losses of the critics are summed, not averaged.
//! 4. Temperature, target entropy, penalties on actions, normalisation and the outcome model are
//!    those of our SAC.

use candle_core::{D, Module, Result, Tensor};
use candle_nn::{VarBuilder, seq};
use dmprl_shared::config::TqcConfig;
use dmprl_shared::policy::Policy;

use super::batch::DeviceBatch;
use super::losses::DeviceLosses;
use super::{Context, CriticStep, Graph, GraphAlgorithm, NamedNetworks, Of, modules};
use crate::algorithms::{new_actor, new_outcome_model};
use crate::update::network::TrainableNetwork;

/// Names of the critics in a checkpoint.
const CRITICS: [&str; TqcConfig::CRITICS_MAX] = [
    "critic_1",
    "critic_2",
    "critic_3",
    "critic_4",
    "critic_5",
    "critic_6",
    "critic_7",
    "critic_8",
    "critic_9",
    "critic_10",
];

#[derive(Debug)]
pub(super) struct Tqc;

impl GraphAlgorithm for Tqc {
    fn networks(&self, context: &Context<'_>, policy: &Policy) -> Result<NamedNetworks> {
        let Context { config, shape } = context;
        let mut networks = vec![("actor", new_actor(config, policy, false)?)];
        for name in &CRITICS[..config.algorithm.tqc.critics] {
            let build = |builder: VarBuilder<'_>| critic(context, &builder);
            networks.push((name, modules::draw(config, name, shape.critic_width(), build)?));
        }
        let sac = &config.algorithm.sac;
        let (initial, rate) = (sac.initial_temperature.ln(), sac.temperature_learning_rate);
        networks.push(("log_temperature", TrainableNetwork::scalar(initial as f32, rate)?));
        networks.extend(new_outcome_model(config, *shape)?.map(|model| ("outcome_model", model)));
        Ok(networks)
    }

    fn module(
        &self,
        context: &Context<'_>,
        name: &str,
        builder: VarBuilder<'_>,
    ) -> Result<Option<Box<dyn Module>>> {
        CRITICS.contains(&name).then(|| critic(context, &builder)).transpose()
    }

    // ANCHOR: update
    fn update(&self, graph: &mut Graph, batch: &DeviceBatch, _: u64) -> Result<DeviceLosses> {
        let tqc = graph.config.algorithm.tqc.clone();
        let critics = &CRITICS[..tqc.critics];

        let next = graph.next_draw(batch)?;
        let all = graph.quantiles(critics, Of::Target, &next.critic_inputs)?;
        let (sorted, _) = all.sort_last_dim(true)?;
        let kept = sorted.narrow(1, 0, tqc.critics * (tqc.quantiles - tqc.dropped_quantiles))?;
        let targets = batch.targets(&kept.broadcast_sub(&next.entropy_cost)?)?;

        let (mut sum, mut first) = (graph.zero()?, None);
        for name in critics {
            let quantiles = graph.forward(name, Of::Network, &batch.critic_inputs)?;
            let (loss, descended) = quantile_loss(&quantiles, &targets)?;
            sum = (sum + loss)?;
            first.get_or_insert(quantiles.detach());
            graph.descend(name, &descended, true)?;
        }

        let q = first.map(|quantiles| quantiles.mean(1)).transpose()?;
        let critic_step = CriticStep::new(sum, q)?;
        graph.soft_actor_step(batch, critic_step, |graph, inputs| {
            graph.quantiles(critics, Of::Frozen, inputs)?.mean_keepdim(1)
        })
    }
    // ANCHOR_END: update
}

impl Graph {
    /// Returns the quantiles of all critics, (B, critics * M).
    fn quantiles(&self, critics: &[&str], of: Of, inputs: &Tensor) -> Result<Tensor> {
        let each = critics.iter().map(|critic| self.forward(critic, of, inputs));
        Tensor::cat(&each.collect::<Result<Vec<_>>>()?, 1)
    }
}

// ANCHOR: critic
/// A critic: a multilayer perceptron from states and actions to M quantiles of the return.
fn critic(context: &Context<'_>, builder: &VarBuilder<'_>) -> Result<Box<dyn Module>> {
    let algorithm = &context.config.algorithm;
    let mut layers = seq();
    let mut inputs = context.shape.critic_width();
    for (index, &width) in algorithm.critic_hidden.iter().enumerate() {
        let layer = builder.pp(index);
        layers = layers.add(modules::linear(inputs, width, &layer)?);
        if algorithm.critic_layer_norm {
            layers = layers.add(modules::layer_norm(width, &layer)?);
        }
        layers = layers.add_fn(Tensor::relu);
        inputs = width;
    }
    let quantiles = modules::linear(inputs, algorithm.tqc.quantiles, &builder.pp("quantiles"))?;
    Ok(Box::new(layers.add(quantiles)))
}
// ANCHOR_END: critic

/// The quantile Huber loss (eq. 8) of quantiles, (B, M), with targets, (B, T): the mean over batch,
/// quantiles and targets of |tau_m - 1(delta < 0)| huber(delta), where delta = target - quantile
/// and tau_m = (2 m - 1) / 2M. Returns its value, and a tensor with the same gradient.
///
/// The second is linear in the quantiles with the loss's slope as constant, because a backward pass
/// over all pairs of quantile and target would take most of an update's time.
fn quantile_loss(quantiles: &Tensor, targets: &Tensor) -> Result<(Tensor, Tensor)> {
    let count = quantiles.dim(1)?;
    let middles = (0..count).map(|m| (2 * m + 1) as f32 / (2 * count) as f32).collect::<Vec<_>>();
    let tau = Tensor::from_vec(middles, (1, count, 1), quantiles.device())?;
    let known = quantiles.detach().unsqueeze(D::Minus1)?;
    let delta = targets.detach().unsqueeze(1)?.broadcast_sub(&known)?;
    let below = delta.lt(0.0)?.to_dtype(delta.dtype())?;
    let clipped = delta.clamp(-1.0, 1.0)?;
    // Minus the derivative with respect to the quantile, for each pair.
    let slope = tau.broadcast_sub(&below)?.abs()?.mul(&clipped)?;
    // huber(delta) = clipped (delta - clipped / 2): delta² / 2 below 1, |delta| - 1/2 above.
    let loss = slope.mul(&(delta - (clipped * 0.5)?)?)?.mean_all()?;
    let linear = slope.mean(2)?.mul(quantiles)?.mean_all()?.neg()?;
    Ok((loss, linear))
}
