//! Thresholds that define when a task counts as learnt, and when the paper reports reaching them.

use super::measures::Measure;

/// Value that an evaluation of a task must reach.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Threshold {
    /// Measure of the evaluation.
    pub measure: Measure,
    /// Its minimum.
    pub value: f64,
    /// Source of the threshold.
    pub source: &'static str,
}

impl Threshold {
    /// Formats `return ≥ -10`.
    #[must_use]
    pub fn text(&self) -> String {
        let what = if self.measure == Measure::Success { "success" } else { "return" };
        format!("{what} ≥ {}", self.value)
    }
}

/// The thresholds by task; other tasks have none.
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

/// Environment steps at which methods reach the threshold, in the words of the paper's section 4.2:
/// task, method, steps. The paper reports no others.
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
    fn both_versions_of_a_task_share_a_threshold() {
        assert_eq!(threshold("reacher").unwrap().text(), "return ≥ -10");
        assert_eq!(threshold("reacher"), threshold("reacher-v1"));
        assert_eq!(threshold("panda-reach-joints").unwrap().text(), "success ≥ 0.95");
        assert_eq!(threshold("point-reach"), None);
    }

    #[test]
    fn the_paper_reports_steps_on_its_own_tasks_only() {
        assert_eq!(reported_steps("reacher-v1", "DDPG"), Some("about 33,000"));
        assert_eq!(reported_steps("reacher", "DDPG"), None);
        assert_eq!(reported_steps("reacher-v1", "DDPG-DMP"), None);
    }
}
