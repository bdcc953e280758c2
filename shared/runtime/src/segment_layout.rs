//! Sizes of a segment (`shared/src/segment.rs`), and bounds of its actions.

/// Sizes that determine a block's layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SegmentLayout {
    /// Segment length K \[steps\].
    pub segment_steps: usize,
    /// Observation length O, including the state (y, yd) if the policy has one.
    pub observation_len: usize,
    /// Action length A.
    pub action_len: usize,
}

impl SegmentLayout {
    /// Returns the length of the block in f32 values.
    #[must_use]
    pub fn block_len(&self) -> usize {
        self.actions_len() + self.observations_len() + self.segment_steps
    }

    fn observations_len(&self) -> usize {
        (self.segment_steps + 1) * self.observation_len
    }

    /// Returns the length of a segment's actions, K A.
    #[must_use]
    pub fn actions_len(&self) -> usize {
        self.segment_steps * self.action_len
    }

    /// Splits a block into observations, actions and rewards.
    ///
    /// # Panics
    /// If the block's length is not [`SegmentLayout::block_len`].
    #[must_use]
    pub fn split<'a>(&self, block: &'a [f32]) -> (&'a [f32], &'a [f32], &'a [f32]) {
        assert_eq!(block.len(), self.block_len(), "segment block length");
        let (observations, rest) = block.split_at(self.observations_len());
        let (actions, rewards) = rest.split_at(self.actions_len());
        (observations, actions, rewards)
    }

    /// Splits a block into mutable observations, actions and rewards.
    ///
    /// # Panics
    /// If the block's length is not [`SegmentLayout::block_len`].
    #[must_use]
    pub fn split_mut<'a>(
        &self,
        block: &'a mut [f32],
    ) -> (&'a mut [f32], &'a mut [f32], &'a mut [f32]) {
        assert_eq!(block.len(), self.block_len(), "segment block length");
        let (observations, rest) = block.split_at_mut(self.observations_len());
        let (actions, rewards) = rest.split_at_mut(self.actions_len());
        (observations, actions, rewards)
    }
}

/// Allowed range of the actions in a segment. Actions are always finite.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionBounds {
    /// In [-1, 1].
    Unit,
    /// Unbounded: draws from an unbounded distribution, before they are clipped to the
    /// environment's bounds.
    None,
}
