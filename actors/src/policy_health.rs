//! Stage 8 of 8, signs of a policy that no longer learns, seen in its evaluations.

use dmprl_shared::supervision::EvaluationRow;

/// Share of actions at their bounds from which two evaluations in a row lead to a warning.
const AT_BOUNDS_MAX: f64 = 0.9;

/// Success rate from which equal evaluations are no cause for a warning.
const SOLVED: f64 = 0.95;

/// Compares each evaluation with the one before. Warns once of each sign.
#[derive(Debug, Default)]
pub struct PolicyHealth {
    previous: Option<EvaluationRow>,
    warned_of_bounds: bool,
    warned_of_repeats: bool,
}

impl PolicyHealth {
    /// Returns the warnings that an evaluation leads to.
    pub fn check(&mut self, row: &EvaluationRow) -> Vec<String> {
        let mut warnings = Vec::new();
        if let Some(previous) = self.previous.replace(row.clone()) {
            if !self.warned_of_bounds && [&previous, row].into_iter().all(is_at_bounds) {
                self.warned_of_bounds = true;
                warnings.push(bounds_message(row));
            }
            if !self.warned_of_repeats && repeats(&previous, row) {
                self.warned_of_repeats = true;
                warnings.push(repeat_message(&previous, row));
            }
        }
        warnings
    }
}

fn is_at_bounds(row: &EvaluationRow) -> bool {
    row.at_bounds.is_some_and(|share| share >= AT_BOUNDS_MAX)
}

fn repeats(previous: &EvaluationRow, row: &EvaluationRow) -> bool {
    let is_solved = row.success_rate.is_some_and(|rate| rate >= SOLVED);
    // Before the first update all policies are the same.
    let is_another = previous.updates > 0 && previous.updates < row.updates;
    !is_solved && is_another && previous.returns == row.returns
}

fn bounds_message(row: &EvaluationRow) -> String {
    format!(
        "warning: {:.0} % of the policy's actions were at their bounds in two evaluations in a \
         row; such a policy hardly learns. If the return is poor, start again with \
         --set algorithm.saturation_penalty=0.003, with --set exploration.warm_up_range=1 and \
         more exploration.warm_up_steps, or with a smaller algorithm.actor_learning_rate",
        100.0 * row.at_bounds.unwrap_or_default()
    )
}

fn repeat_message(previous: &EvaluationRow, row: &EvaluationRow) -> String {
    format!(
        "warning: policies {} and {} had the same return in each of {} episodes; what they do \
         differently does not change the reward. If the return is poor, explore more \
         (exploration.std, exploration.warm_up_range); for goals with a sparse reward use \
         --preset goal",
        previous.policy_version,
        row.policy_version,
        row.returns.len()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(policy_version: u64, at_bounds: f64, returns: &[f64]) -> EvaluationRow {
        EvaluationRow {
            env_steps: 1_000 * policy_version,
            updates: 100 * (policy_version - 1),
            segments: 0,
            wall_s: 0.0,
            policy_version,
            returns: returns.to_vec(),
            return_mean: returns.iter().sum::<f64>() / returns.len() as f64,
            success_rate: None,
            smoothness: 0.0,
            at_bounds: Some(at_bounds),
        }
    }

    #[test]
    fn actions_at_their_bounds_are_told_once_and_only_after_two_evaluations() {
        let mut health = PolicyHealth::default();
        assert!(health.check(&row(1, 0.95, &[1.0])).is_empty());
        assert!(health.check(&row(2, 0.5, &[2.0])).is_empty());
        assert!(health.check(&row(3, 0.95, &[3.0])).is_empty());
        let warnings = health.check(&row(4, 0.97, &[4.0]));
        assert!(matches!(&warnings[..], [text] if text.starts_with("warning: 97 % of the policy")));
        assert!(health.check(&row(5, 1.0, &[5.0])).is_empty());
    }

    #[test]
    fn another_policy_with_the_same_returns_is_told_once() {
        let mut health = PolicyHealth::default();
        // Without updates; a policy that was updated; the same, evaluated again after a restart.
        for version in [1, 2, 2] {
            assert!(health.check(&row(version, 0.0, &[-50.0, 0.0])).is_empty());
        }
        let warnings = health.check(&row(3, 0.0, &[-50.0, 0.0]));
        assert!(matches!(&warnings[..], [text] if text.contains("policies 2 and 3 had the same")));
        assert!(health.check(&row(4, 0.0, &[-50.0, 0.0])).is_empty());
    }

    #[test]
    fn a_solved_task_is_no_cause_for_a_warning() {
        let mut health = PolicyHealth::default();
        let solved =
            |version| EvaluationRow { success_rate: Some(1.0), ..row(version, 0.0, &[-1.0]) };
        assert!((1..4).all(|version| health.check(&solved(version)).is_empty()));
    }
}
