//! The figures that an update reports: losses, Q and policy statistics.

/// Losses of one update, as means over the batch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Losses {
    /// (Q - target)², summed over the critics.
    pub critic_loss: f32,
    /// The actor's loss; `None` if the update does not change the actor.
    pub actor_loss: Option<f32>,
    /// Q of the batch's actions, from the first critic.
    pub q_mean: f32,
    /// SAC: weight of the entropy.
    pub temperature: Option<f32>,
    /// SAC: -log pi of the sampled actions \[nat\].
    pub entropy: Option<f32>,
}
