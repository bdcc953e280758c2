//! Initial state (y0, yd0) of a segment's DMP, for every action dimension.

use super::{PolicyDescription, PolicyError};
use crate::config::{Start, StartSource, StartVelocity};
use crate::spec::EnvSpec;

/// Source of (y0, yd0).
#[derive(Debug, Clone, PartialEq)]
pub enum StartState {
    /// y0 = yd0 = 0.
    Zero,
    /// Read from the observation with one source per dimension. Velocities are multiplied by
    /// `velocity_scale`.
    Observed {
        /// Entries of the observation that are each dimension's position and velocity.
        sources: Vec<StartSource>,
        /// Duration of a segment, K * control_dt_s [s], or 0 for `start_velocity = "zero"`. It
        /// converts velocities to DMP time, in which a segment lasts tau = 1.
        velocity_scale: f32,
    },
    /// y (A,), then yd (A,) follow the environment's observation at this index.
    Appended {
        /// Length of the environment's observation.
        at: usize,
    },
}

impl StartState {
    /// Creates the source of the described policy.
    ///
    /// # Errors
    /// `StartSources` if `task.start_sources` does not fit the environment.
    pub fn new(description: &PolicyDescription) -> Result<Self, PolicyError> {
        let PolicyDescription { spec, policy, start_sources, .. } = description;
        match policy.start {
            Start::Zero => Ok(Self::Zero),
            Start::Carry | Start::Action => Ok(Self::Appended { at: spec.observation_len }),
            Start::Observed => {
                check_start_sources(start_sources, spec)?;
                let segment_s = policy.segment_steps as f64 * spec.control_dt_s;
                let measured = policy.start_velocity == StartVelocity::Measured;
                let velocity_scale = if measured { segment_s as f32 } else { 0.0 };
                Ok(Self::Observed { sources: start_sources.clone(), velocity_scale })
            }
        }
    }

    /// Returns (y0, yd0) of action dimension `d` of `dims`.
    #[must_use]
    pub fn read(&self, observation: &[f32], d: usize, dims: usize) -> (f32, f32) {
        match self {
            Self::Zero => (0.0, 0.0),
            Self::Appended { at } => (observation[at + d], observation[at + dims + d]),
            Self::Observed { sources, velocity_scale } => match &sources[d] {
                StartSource::Angle { cos, sin, velocity } => {
                    // Adding 0 turns -0 into 0, for which atan2 returns pi instead of -pi.
                    let angle = (observation[*sin] + 0.0).atan2(observation[*cos] + 0.0);
                    (angle, observation[*velocity] * velocity_scale)
                }
                StartSource::Value { index, velocity, scale } => {
                    (scale * observation[*index], observation[*velocity] * velocity_scale)
                }
            },
        }
    }
}

/// Checks that there is a source for each action dimension, with entries of the observation.
///
/// # Errors
/// `StartSources` if not.
pub fn check_start_sources(sources: &[StartSource], spec: &EnvSpec) -> Result<(), PolicyError> {
    if sources.len() != spec.action_len {
        return Err(PolicyError::StartSources(format!(
            "{} entries, expected one for each of the {} action dimensions of {}",
            sources.len(),
            spec.action_len,
            spec.id
        )));
    }
    for (dimension, source) in sources.iter().enumerate() {
        let indices = match source {
            StartSource::Angle { cos, sin, velocity } => [*cos, *sin, *velocity],
            StartSource::Value { index, velocity, .. } => [*index, *index, *velocity],
        };
        if let Some(index) = indices.iter().find(|&&index| index >= spec.observation_len) {
            return Err(PolicyError::StartSources(format!(
                "dimension {dimension} reads index {index}, but observations of {} have length {}",
                spec.id, spec.observation_len
            )));
        }
    }
    Ok(())
}
