//! A sample of a batch: a window, with another goal if hindsight draws one.

use dmprl_shared::config::{AlgorithmConfig, Target};

use crate::replay::{Goal, GoalSampler, Outcome, Replay, Sampler, Window};

/// A window with the goal and the outcome that the batch takes.
pub(super) struct Sample<'a> {
    pub(super) window: Window,
    pub(super) outcome: Outcome,
    /// Another goal, or `None` for the window's own.
    pub(super) goal: Option<Goal<'a>>,
    /// Adds a bonus to the reward, if configured.
    pub(super) hindsight: Option<&'a GoalSampler>,
}

impl<'a> Sample<'a> {
    /// Draws a window, and a goal for it, if hindsight is configured. Returns `None` if the replay
    /// has no window.
    pub(super) fn draw(
        replay: &'a Replay,
        hindsight: Option<&'a GoalSampler>,
        sampler: &mut Sampler,
    ) -> Option<Self> {
        let window = match (sampler.draw_shared(replay), hindsight) {
            (Some(demonstrated), _) => demonstrated,
            (None, Some(hindsight)) => hindsight.draw_window(replay, sampler)?,
            (None, None) => sampler.draw(replay)?,
        };
        let drawn = hindsight.and_then(|hindsight| {
            let goal = hindsight.draw(replay, &window, sampler.random_mut())?;
            let outcome = replay.outcome(&window, goal)?;
            Some(Self { window, outcome, goal: Some(goal), hindsight: Some(hindsight) })
        });
        Some(drawn.unwrap_or_else(|| {
            let outcome = Outcome { steps: window.len(), terminated: window.terminated };
            Self { window, outcome, goal: None, hindsight }
        }))
    }
}

/// Returns the range of the targets: that of the returns that a sparse goal rule allows. The soft
/// values of SAC and TQC and the undiscounted sums of `literal` have no such range.
pub(super) fn target_range(hindsight: Option<&GoalSampler>, config: &AlgorithmConfig) -> [f32; 2] {
    let is_return = config.target == Target::NStep && !config.name.has_gaussian_policy();
    hindsight
        .filter(|_| is_return)
        .and_then(|hindsight| hindsight.return_range(config.discount))
        .unwrap_or([f32::NEG_INFINITY, f32::INFINITY])
}
