//! Thresholds at which a task counts as learnt, and the steps after which the paper reports to
//! reach them.

use super::measures::Measure;

/// Minimum that an evaluation must reach for its task to count as learnt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Threshold {
    /// Measure of the evaluation.
    pub measure: Measure,
    /// Minimum of the measure.
    pub value: f64,
    /// Source of the threshold.
    pub source: &'static str,
}

impl Threshold {
    /// Describes the threshold, such as `return ≥ -10`.
    #[must_use]
    pub fn text(&self) -> String {
        let what = if self.measure == Measure::Success { "success" } else { "return" };
        format!("{what} ≥ {}", self.value)
    }
}

/// Thresholds by task; other tasks have none.
const THRESHOLDS: [(&[&str], Threshold); 4] = [
    (
        &["reacher-v1", "reacher"],
        Threshold { measure: Measure::Return, value: -10.0, source: "the paper's section 4.2" },
    ),
    (
        &["pusher-v0", "pusher"],
        Threshold { measure: Measure::Return, value: -40.0, source: "the paper's section 4.2" },
    ),
    (
        &["thrower-v0", "thrower"],
        Threshold {
            measure: Measure::Return,
            value: -74.9,
            source: "NDP's return in the paper's Table 3",
        },
    ),
    (
        &["panda-reach", "panda-reach-joints"],
        Threshold {
            measure: Measure::Success,
            value: 0.95,
            source: "ours; the paper says \"almost 100 %\"",
        },
    ),
];

/// Task, method, and the environment steps after which it reaches the threshold, in the words of
/// the paper's section 4.2. The paper reports no others.
const REPORTED_STEPS: [(&str, &str, &str); 5] = [
    ("reacher-v1", "DDPG-DMP (paper)", "about 26,000"),
    ("reacher-v1", "DDPG", "about 33,000"),
    ("pusher-v0", "DDPG-DMP (paper)", "within 30,000"),
    ("thrower-v0", "NDP", "about 150,000"),
    ("thrower-v0", "DDPG-DMP (paper)", "a third of NDP's"),
];

/// Returns the threshold of a task.
#[must_use]
pub fn threshold(task: &str) -> Option<&'static Threshold> {
    let of_task = THRESHOLDS.iter().find(|(tasks, _)| tasks.contains(&task));
    of_task.map(|(_, threshold)| threshold)
}

/// Returns the steps that the paper reports for a method, in its words.
#[must_use]
pub fn reported_steps(task: &str, method: &str) -> Option<&'static str> {
    let reported = REPORTED_STEPS.iter().find(|entry| (entry.0, entry.1) == (task, method));
    reported.map(|entry| entry.2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_of_a_task_share_a_threshold() {
        assert_eq!(threshold("reacher").unwrap().text(), "return ≥ -10");
        assert_eq!(threshold("reacher"), threshold("reacher-v1"));
        assert_eq!(threshold("panda-reach-joints").unwrap().text(), "success ≥ 0.95");
        assert_eq!(threshold("point-reach"), None);
    }

    #[test]
    fn steps_are_reported_only_for_the_papers_tasks_and_methods() {
        assert_eq!(reported_steps("reacher-v1", "DDPG"), Some("about 33,000"));
        assert_eq!(reported_steps("reacher", "DDPG"), None);
        assert_eq!(reported_steps("reacher-v1", "DDPG-DMP"), None);
    }
}
