//! Penalties in the actor's loss: on the rate and the acceleration of the actions, on their
//! distance from actions that led to the goal, and on saturation.
//!
//! The first three are sums over a decision's noise-free actions and their dimensions. u_{t-1} and
//! u_{t-2} are read from the replay; terms with an action that does not exist are absent. The third
//! is for rows whose window led to its goal, with the window's actions a_k. The last is a sum over
//! everything that gets a tanh: the head's outputs and the means.
//!     rate:          sum (u_k - u_{k-1})²
//!     acceleration:  sum (u_k - 2 u_{k-1} + u_{k-2})²
//!     imitation:     sum (u_k - a_k)²
//!     saturation:    sum max(|x_i| - 2, 0)²
//! Weights are relative to the batch's mean |Q|, so they do not depend on the scale of rewards.

use dmprl_shared::config::AlgorithmConfig;

/// Largest |x| before a tanh without a penalty on saturation. tanh(2) is 0.96, its slope 0.07.
pub const UNSATURATED_MAX: f32 = 2.0;

/// Weights of the penalties, in units of Q once they are multiplied by |Q|.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ActionPenalties {
    rate: f32,
    acceleration: f32,
    imitation: f32,
    saturation: f32,
}

/// One row's actions, and those before them.
#[derive(Debug, Clone, Copy)]
pub struct ActionRow<'a> {
    /// u of the decision, (K, A).
    pub actions: &'a [f32],
    /// u_{t-2} and u_{t-1}, (2, A).
    pub previous: &'a [f32],
    /// 1 if u_{t-2}, and u_{t-1}, exist, else 0.
    pub has_previous: [f32; 2],
    /// Actions that led to the goal, (K, A), if they did.
    pub imitated: Option<&'a [f32]>,
}

impl ActionPenalties {
    /// Reads the weights, as shares of |Q|.
    #[must_use]
    pub fn new(config: &AlgorithmConfig) -> Self {
        Self {
            rate: config.action_rate_penalty as f32,
            acceleration: config.action_acceleration_penalty as f32,
            imitation: config.imitation_penalty as f32,
            saturation: config.saturation_penalty as f32,
        }
    }

    /// Returns the weights in units of Q, for a batch with this mean |Q|.
    #[must_use]
    pub fn of(self, q_size: f32) -> Self {
        Self {
            rate: self.rate * q_size,
            acceleration: self.acceleration * q_size,
            imitation: self.imitation * q_size,
            saturation: self.saturation * q_size,
        }
    }

    /// Returns whether any actions within the bounds cost nothing.
    #[must_use]
    pub fn ignore_actions(self) -> bool {
        (self.rate, self.acceleration, self.imitation) == (0.0, 0.0, 0.0)
    }

    /// Returns the penalty on the saturation of some values before their tanh. Adds its gradient,
    /// divided by `rows`, to `gradient`.
    pub fn add_saturation(self, values: &[f32], gradient: &mut [f32], rows: f32) -> f32 {
        if self.saturation == 0.0 {
            return 0.0;
        }
        let slope = 2.0 * self.saturation / rows;
        let mut sum = 0.0;
        for (value, gradient) in values.iter().zip(gradient) {
            let excess = (value.abs() - UNSATURATED_MAX).max(0.0);
            sum += excess * excess;
            *gradient += slope * excess.copysign(*value);
        }
        self.saturation * sum
    }

    /// Returns the penalty on the actions of a row. Adds its gradient with respect to action `i`,
    /// multiplied by `slope(i)`, to `gradient`, (K, A).
    pub fn add(
        self,
        row: ActionRow<'_>,
        gradient: &mut [f32],
        slope: impl Fn(usize) -> f32,
    ) -> f32 {
        let ActionRow { actions, previous, has_previous, imitated } = row;
        let dims = previous.len() / 2;
        // Action i - back dims, which is one of the previous ones for small i.
        let before = |i: usize, back: usize| match i.checked_sub(back * dims) {
            Some(at) => actions[at],
            None => previous[i + (2 - back) * dims],
        };
        let mut sum = 0.0;
        for i in 0..actions.len() {
            let has = |back: usize| match i / dims {
                k if k < back => has_previous[2 + k - back],
                _ => 1.0,
            };
            let (last, last_but_one) = (before(i, 1), before(i, 2));
            let change = has(1) * (actions[i] - last);
            let turn = has(2) * (actions[i] - 2.0 * last + last_but_one);
            sum += self.rate * change * change + self.acceleration * turn * turn;
            let distance = imitated.map_or(0.0, |imitated| actions[i] - imitated[i]);
            sum += self.imitation * distance * distance;
            let (change, turn) = (2.0 * self.rate * change, 2.0 * self.acceleration * turn);
            gradient[i] += slope(i) * (change + turn + 2.0 * self.imitation * distance);
            if let Some(at) = i.checked_sub(dims) {
                gradient[at] -= slope(at) * (change + 2.0 * turn);
            }
            if let Some(at) = i.checked_sub(2 * dims) {
                gradient[at] += slope(at) * turn;
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two dimensions, three steps; the second dimension is always 0.
    #[test]
    fn penalties_of_a_row_equal_hand_worked_ones() {
        let previous = [0.1, 0.0, 0.2, 0.0];
        let row = |has_previous| ActionRow {
            actions: &[0.5, 0.0, 0.5, 0.0, 0.1, 0.0],
            previous: &previous,
            has_previous,
            imitated: None,
        };
        let penalty = |rate, acceleration, has_previous| {
            let penalties = ActionPenalties { rate, acceleration, ..Default::default() };
            penalties.add(row(has_previous), &mut [0.0; 6], |_| 1.0)
        };
        for (got, expected) in [
            (penalty(1.0, 0.0, [1.0, 1.0]), 0.09 + 0.0 + 0.16),
            (penalty(1.0, 0.0, [0.0, 0.0]), 0.0 + 0.16),
            // 0.5 - 0.4 + 0.1, 0.5 - 1.0 + 0.2 and 0.1 - 1.0 + 0.5.
            (penalty(0.0, 1.0, [1.0, 1.0]), 0.04 + 0.09 + 0.16),
            (penalty(0.0, 1.0, [0.0, 1.0]), 0.09 + 0.16),
            (penalty(0.0, 1.0, [0.0, 0.0]), 0.16),
            (penalty(2.0, 3.0, [0.0, 0.0]), 0.32 + 0.48),
        ] {
            assert!((got - expected).abs() < 1e-6, "{got} {expected}");
        }
    }

    #[test]
    fn the_distance_from_actions_that_led_to_the_goal_costs_its_square() {
        let penalties = ActionPenalties { imitation: 2.0, ..Default::default() };
        let cost = |imitated| {
            let actions = &[0.5, -0.1];
            let row = ActionRow { actions, previous: &[0.0; 2], has_previous: [1.0; 2], imitated };
            let mut gradient = [1.0; 2];
            (penalties.add(row, &mut gradient, |_| 0.5), gradient)
        };
        assert_eq!(cost(None), (0.0, [1.0; 2]));
        let (sum, gradient) = cost(Some(&[0.25, 0.4]));
        assert!((sum - 2.0 * (0.0625 + 0.25)).abs() < 1e-6, "{sum}");
        // 2 * 2 * 0.25 and 2 * 2 * -0.5, times the slope.
        assert!((gradient[0] - 1.5).abs() < 1e-6 && gradient[1].abs() < 1e-6, "{gradient:?}");
    }

    #[test]
    fn saturation_costs_nothing_up_to_2_and_the_square_beyond() {
        let penalties = ActionPenalties { saturation: 0.5, ..Default::default() };
        let mut gradient = [1.0; 5];
        let sum = penalties.add_saturation(&[0.0, -2.0, 2.5, -4.0, 3.0], &mut gradient, 4.0);
        assert!((sum - 0.5 * (0.25 + 4.0 + 1.0)).abs() < 1e-6, "{sum}");
        assert_eq!(gradient, [1.0, 1.0, 1.125, 0.5, 1.25]);
    }
}
