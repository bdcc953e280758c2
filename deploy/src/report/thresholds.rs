//! Marks that learning is timed by: what counts as learnt, and when the paper says it was.

use super::measures::Measure;

/// What a task's evaluation has to reach.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Threshold {
    /// Of an evaluation.
    pub measure: Measure,
    /// At least this.
    pub value: f64,
    /// Who says so.
    pub source: &'static str,
}

impl Threshold {
    /// `return ≥ -10`.
    #[must_use]
    pub fn text(&self) -> String {
        let what = if self.measure == Measure::Success { "success" } else { "return" };
        format!("{what} ≥ {}", self.value)
    }
}

/// The thresholds of every task that has one; a user's own tasks have none.
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

/// When the paper says that a method is there (section 4.2; it gives no more than these):
/// task, method, words, steps.
const MARKS: [(&str, &str, &str, f64); 5] = [
    ("reacher-v1", "DDPG-DMP (paper)", "about 26,000", 26_000.0),
    ("reacher-v1", "DDPG", "about 33,000", 33_000.0),
    ("pusher-v0", "DDPG-DMP (paper)", "within 30,000", 30_000.0),
    ("thrower-v0", "NDP", "about 150,000", 150_000.0),
    ("thrower-v0", "DDPG-DMP (paper)", "a third of NDP's", 50_000.0),
];

/// The threshold of a task.
#[must_use]
pub fn threshold(task: &str) -> Option<&'static Threshold> {
    let of_task = THRESHOLDS.iter().find(|(tasks, _)| tasks.contains(&task));
    of_task.map(|(_, threshold)| threshold)
}

/// What the paper says of a method's steps there, in words and as a number.
#[must_use]
pub fn mark(task: &str, method: &str) -> Option<(&'static str, f64)> {
    let of_both = MARKS.iter().find(|mark| (mark.0, mark.1) == (task, method));
    of_both.map(|mark| (mark.2, mark.3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_versions_of_a_task_share_a_threshold_and_a_users_own_has_none() {
        assert_eq!(threshold("reacher").unwrap().text(), "return ≥ -10");
        assert_eq!(threshold("reacher"), threshold("reacher-v1"));
        assert_eq!(threshold("panda-reach-joints").unwrap().text(), "success ≥ 0.95");
        assert_eq!(threshold("point-reach"), None);
    }

    #[test]
    fn the_papers_marks_are_of_its_own_tasks() {
        assert_eq!(mark("reacher-v1", "DDPG"), Some(("about 33,000", 33_000.0)));
        assert_eq!(mark("reacher", "DDPG"), None);
        assert_eq!(mark("reacher-v1", "DDPG-DMP"), None);
    }
}
