//! Penalties on changes of the actions in the actor's loss: on their rate and their acceleration.
//!
//! They are sums over a decision's noise-free actions and their dimensions. u_{t-1} and u_{t-2} are
//! read from the replay; terms with an action that does not exist are absent.
//!     rate:          sum (u_k - u_{k-1})²
//!     acceleration:  sum (u_k - 2 u_{k-1} + u_{k-2})²
//! Weights are relative to the batch's mean |Q|, so they do not depend on the scale of rewards.

use dmprl_shared::config::AlgorithmConfig;

/// Weights of both penalties, in units of Q once they are multiplied by |Q|.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionPenalties {
    rate: f32,
    acceleration: f32,
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
}

impl ActionPenalties {
    /// Reads the weights, as shares of |Q|.
    #[must_use]
    pub fn new(config: &AlgorithmConfig) -> Self {
        Self {
            rate: config.action_rate_penalty as f32,
            acceleration: config.action_acceleration_penalty as f32,
        }
    }

    /// Returns the weights in units of Q, for a batch with this mean |Q|.
    #[must_use]
    pub fn of(self, q_size: f32) -> Self {
        Self { rate: self.rate * q_size, acceleration: self.acceleration * q_size }
    }

    /// Returns whether there is nothing to add.
    #[must_use]
    pub fn is_none(self) -> bool {
        self == Self { rate: 0.0, acceleration: 0.0 }
    }

    /// Returns the penalty of a row. Adds its gradient with respect to action `i`, multiplied by
    /// `slope(i)`, to `gradient`, (K, A).
    pub fn add(
        self,
        row: ActionRow<'_>,
        gradient: &mut [f32],
        slope: impl Fn(usize) -> f32,
    ) -> f32 {
        let ActionRow { actions, previous, has_previous } = row;
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
            let (change, turn) = (2.0 * self.rate * change, 2.0 * self.acceleration * turn);
            gradient[i] += slope(i) * (change + turn);
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
        };
        let penalty = |rate, acceleration, has_previous| {
            let penalties = ActionPenalties { rate, acceleration };
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
}
