//! The last command and its rate of change, from which a segment starts with `start = "action"`.

/// Follows the actions of an environment.
///
/// The state is y (A,), then yd (A,): y = tanh⁻¹(u) of the last action u, which the controller
/// `direct` converts back to u, and yd is the change of y in the last step, in DMP time, in which a
/// segment lasts tau = 1. It is zero at the start of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandState {
    /// Steps per unit of DMP time, K.
    steps: f32,
}

impl CommandState {
    /// Larger actions count as this one, because tanh⁻¹ of 1 is infinite.
    pub const U_MAX: f32 = 0.995;

    pub(super) fn new(segment_steps: usize) -> Self {
        Self { steps: segment_steps as f32 }
    }

    /// Advances the state, (2A,), by one control step with action `u`, (A,).
    pub fn follow(&self, u: &[f32], state: &mut [f32]) {
        let (y, yd) = state.split_at_mut(u.len());
        for ((u, y), yd) in u.iter().zip(y).zip(yd) {
            let next = u.clamp(-Self::U_MAX, Self::U_MAX).atanh();
            *yd = (next - *y) * self.steps;
            *y = next;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::Policy;
    use crate::seeds;
    use crate::spec::EnvSpec;
    use crate::test_support::description;

    /// Runs three segments of a random policy from the start of an episode. Returns the largest
    /// jumps of the action and of its rate of change, per DMP time, at their borders. At the start
    /// of the episode the robot is at rest at u = 0.
    fn jumps(segment_steps: usize) -> [f32; 2] {
        let steps = segment_steps.to_string();
        let keys = [
            ("policy.start", "action"),
            ("policy.controller", "direct"),
            ("policy.hidden", "[16]"),
            ("policy.segment_steps", &steps),
            ("dmp.integration_steps", &steps),
            // With `exact` the phase does not depend on the number of steps.
            ("dmp.canonical", "exact"),
        ];
        let spec = EnvSpec::new("Test-v0", 1, &[(-1.0, 1.0); 2], 0.02, 1000);
        let policy = Policy::new(description(spec, &keys)).unwrap();
        let mut parameters = policy.initial_parameters(&mut seeds::stream(1, "test", 0));
        parameters.iter_mut().for_each(|parameter| *parameter *= 3.0);
        let mut work = policy.workspace(1);
        let per_time = segment_steps as f32;
        let (mut state, mut last, mut largest) = ([0.0; 4], [[0.0; 2]; 2], [0.0_f32; 2]);
        for segment in 0..3 {
            let mut seen = vec![segment as f32 - 1.0];
            seen.extend_from_slice(&state);
            policy.act(&parameters, &seen, &mut work);
            let first = &work.actions[..2];
            for d in 0..2 {
                let (step, step_before) = (first[d] - last[1][d], last[1][d] - last[0][d]);
                largest[0] = largest[0].max(step.abs());
                largest[1] = largest[1].max((step - step_before).abs() * per_time);
            }
            for u in work.actions.chunks_exact(2) {
                policy.command_state().unwrap().follow(u, &mut state);
                last = [last[1], [u[0], u[1]]];
            }
        }
        largest
    }

    /// Actions and rates differ at a border by no more than the change within one step, so with 16
    /// times as many steps the jumps are about 16 times smaller, or more.
    #[test]
    fn action_and_its_rate_are_continuous_across_segments_and_at_the_start_of_an_episode() {
        let (coarse, fine) = (jumps(15), jumps(240));
        for (coarse, fine) in coarse.into_iter().zip(fine) {
            assert!(coarse > 1e-3, "actions of nothing: {coarse}");
            assert!(coarse > 8.0 * fine, "{coarse} {fine}");
        }
    }

    #[test]
    fn state_is_the_last_action_and_its_change() {
        let state_of = CommandState::new(5);
        let mut state = [0.0; 4];
        state_of.follow(&[0.5_f32.tanh(), 0.0], &mut state);
        for (got, expected) in state.iter().zip([0.5, 0.0, 2.5, 0.0]) {
            assert!((got - expected).abs() < 1e-5, "{state:?}");
        }
        state_of.follow(&[0.25_f32.tanh(), -1.0], &mut state);
        let limit = CommandState::U_MAX.atanh();
        for (got, expected) in state.iter().zip([0.25, -limit, -1.25, -5.0 * limit]) {
            assert!((got - expected).abs() < 1e-5, "{state:?}");
        }
    }
}
