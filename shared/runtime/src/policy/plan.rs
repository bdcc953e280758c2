//! The actions that a policy has planned for the next steps.

use crate::segment_layout::SegmentLayout;

/// Planned actions u of up to K steps. Segments are added; actions are taken.
///
/// If a segment is added before the plan is empty, each step gets the mean of both. If one is added
/// at every step, an action has the weight 1/2 for the newest segment, 1/4 for the one before, and
/// so on. That is the temporal ensemble of Zhao et al. 2023 ("Learning Fine-Grained Bimanual
/// Manipulation with Low-Cost Hardware", section IV-A), except that theirs prefers old segments.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// u, (K, A), in [-1, 1].
    actions: Vec<f32>,
    action_len: usize,
    /// Number of actions that have been taken, times A.
    taken: usize,
}

impl Plan {
    /// Creates an empty plan.
    #[must_use]
    pub fn new(layout: SegmentLayout) -> Self {
        let actions = vec![0.0; layout.actions_len()];
        Self { taken: actions.len(), actions, action_len: layout.action_len }
    }

    /// Whether no action is left.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.taken == self.actions.len()
    }

    /// Drops the remaining actions.
    pub fn clear(&mut self) {
        self.taken = self.actions.len();
    }

    /// Adds a segment of actions u, (K, A), that starts at the next step. They are clipped to
    /// [-1, 1], because the mean of a Gaussian may be outside.
    ///
    /// # Panics
    /// If the length is wrong.
    pub fn add(&mut self, segment: &[f32]) {
        assert_eq!(segment.len(), self.actions.len(), "actions of a segment");
        let taken = std::mem::take(&mut self.taken);
        for (index, u) in segment.iter().enumerate() {
            let u = u.clamp(-1.0, 1.0);
            // An entry is read before it is written, at the same index or a lower one.
            let planned = self.actions.get(taken + index);
            self.actions[index] = planned.map_or(u, |planned| 0.5 * (planned + u));
        }
    }

    /// Takes the next action, (A,); `None` if the plan is empty.
    pub fn take(&mut self) -> Option<&[f32]> {
        if self.is_empty() {
            return None;
        }
        let first = self.taken;
        self.taken += self.action_len;
        Some(&self.actions[first..self.taken])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(segment_steps: usize, action_len: usize) -> Plan {
        Plan::new(SegmentLayout { segment_steps, observation_len: 1, action_len })
    }

    #[test]
    fn a_segment_for_an_empty_plan_is_taken_as_it_is_but_clipped() {
        let mut plan = plan(2, 2);
        assert_eq!(plan.take(), None);
        plan.add(&[0.5, -3.0, 0.25, 1.5]);
        assert_eq!(plan.take(), Some(&[0.5, -1.0][..]));
        assert_eq!(plan.take(), Some(&[0.25, 1.0][..]));
        assert!(plan.is_empty());
        plan.add(&[0.125; 4]);
        plan.clear();
        plan.add(&[0.75; 4]);
        assert_eq!(plan.take(), Some(&[0.75; 2][..]), "not blended with the dropped actions");
    }

    /// Segments of ones and zeros show the weights.
    #[test]
    fn newer_segments_weigh_twice_as_much_as_the_ones_before() {
        let mut plan = plan(3, 1);
        plan.add(&[1.0; 3]);
        assert_eq!(plan.take(), Some(&[1.0][..]));
        plan.add(&[0.0; 3]); // plan: 1/2, 1/2, 0
        assert_eq!(plan.take(), Some(&[0.5][..]));
        plan.add(&[0.0; 3]); // plan: 1/4, 0, 0
        assert_eq!(plan.take(), Some(&[0.25][..]));
        plan.add(&[0.0; 3]);
        assert_eq!(plan.take(), Some(&[0.0][..]), "the first segment has no fourth step");
    }

    #[test]
    fn a_plan_goes_on_without_new_segments() {
        let mut plan = plan(3, 1);
        plan.add(&[0.0, 0.5, 1.0]);
        plan.take();
        plan.take();
        plan.add(&[0.0, 0.25, 0.5]);
        let left = std::iter::from_fn(|| plan.take().map(|u| u[0])).collect::<Vec<_>>();
        assert_eq!(left, [0.5, 0.25, 0.5]);
    }
}
