//! The results of the paper's Tables 3 and 4.

/// Returns of Table 3. The printed table has no minus signs; the paper's figures show them.
const RETURNS: [Row; 3] = [
    Row("reacher-v1", [(-7.36, 0.54), (-6.58, 0.54), (-7.89, 0.57), (-6.10, 0.61), (-15.56, 1.47)]),
    Row(
        "pusher-v0",
        [(-33.37, 1.73), (-44.23, 8.82), (-32.06, 1.41), (-31.87, 4.01), (-46.81, 2.16)],
    ),
    Row(
        "thrower-v0",
        [(-62.74, 9.78), (-180.37, 24.61), (-111.52, 23.74), (-95.33, 27.72), (-74.90, 18.27)],
    ),
];

/// Success rates of Table 4.
const SUCCESS: [Row; 2] = [
    Row("panda-reach", [(0.99, 0.00), (0.41, 0.24), (0.99, 0.00), (0.99, 0.01), (0.0, 0.0)]),
    Row("panda-reach-joints", [(0.99, 0.01), (0.0, 0.0), (0.92, 0.01), (0.85, 0.41), (0.0, 0.0)]),
];

/// The method that follows this project's first interpretation of the paper.
pub const INTERPRETED_METHOD: &str = "DDPG-DMP (paper)";
/// Footnote about the interpretation, next to the figures of that method.
pub const INTERPRETATION_NOTE: &str = "¹ DDPG-DMP (paper) is one interpretation of the paper, \
    which does not specify these choices: goal, weights and rho are bounded by tanh; the inputs of \
    the controller are velocity and acceleration divided by omega and omega²; the target takes \
    s' = s_{t+1} after the sum of K rewards; forcing-term widths follow NDP's code. \
    deploy/experiments/paper.toml has other interpretations.";

/// Number of seeds of each result in the paper.
pub const SEEDS: usize = 5;

/// Columns of both tables.
const METHODS: [&str; 5] = ["DDPG-DMP (paper)", "DDPG", "TD3", "SAC", "NDP"];

struct Row(&'static str, [(f64, f64); 5]);

/// A table of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PaperTable {
    /// Return: Table 3.
    Return,
    /// Success rate: Table 4.
    Success,
}

/// Returns the mean and standard deviation that the paper reports; `None` if it reports none.
///
/// - `task`, `method`: names in `deploy/experiments/paper.toml`.
#[must_use]
pub fn reported(table: PaperTable, task: &str, method: &str) -> Option<(f64, f64)> {
    let rows: &[Row] = match table {
        PaperTable::Return => &RETURNS,
        PaperTable::Success => &SUCCESS,
    };
    let Row(_, row) = rows.iter().find(|Row(name, _)| *name == task)?;
    let column = METHODS.iter().position(|name| *name == method)?;
    Some(row[column])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_found_by_task_and_method() {
        assert_eq!(reported(PaperTable::Return, "pusher-v0", "SAC"), Some((-31.87, 4.01)));
        assert_eq!(reported(PaperTable::Success, "panda-reach", "DDPG"), Some((0.41, 0.24)));
        assert_eq!(reported(PaperTable::Return, "panda-reach", "DDPG"), None);
        assert_eq!(reported(PaperTable::Return, "reacher", "SAC"), None);
        assert_eq!(reported(PaperTable::Return, "reacher-v1", "TD3-DMP"), None);
    }
}
