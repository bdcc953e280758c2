//! Windows of up to K consecutive steps.

use super::{NONE, Replay};

/// K steps from step `offset` of `slot` on, which continue in the next slot if `offset` > 0.
///
/// A window has fewer than K steps only if the episode terminated. Steps that a time limit cut
/// short are no window, because a missing action is not a zero action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    pub(super) slot: u32,
    pub(super) offset: u8,
    /// Steps taken from the first slot.
    first_len: u8,
    /// Steps taken from the next slot.
    second_len: u8,
    next: u32,
    /// Whether the episode terminated at the window's last step.
    pub terminated: bool,
}

impl Window {
    /// Returns the number of steps n, 1 to K.
    #[must_use]
    pub fn len(&self) -> usize {
        usize::from(self.first_len) + usize::from(self.second_len)
    }

    /// Returns false, because a window has at least one step.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        false
    }
}

impl Replay {
    /// Returns the window that starts at step `offset` of `slot`, if there is one.
    #[must_use]
    pub fn window(&self, slot: usize, offset: usize) -> Option<Window> {
        let steps = self.layout.segment_steps;
        let first = self.slots[slot];
        let first_len = usize::from(first.steps_len).checked_sub(offset).filter(|&len| len > 0)?;
        let window = |second_len: usize, next: u32, terminated: bool| {
            Some(Window {
                slot: slot as u32,
                offset: offset as u8,
                first_len: first_len as u8,
                second_len: second_len as u8,
                next,
                terminated,
            })
        };
        if first_len == steps || first.terminated {
            return window(0, NONE, first.terminated);
        }
        if first.truncated || first.next == NONE {
            return None;
        }
        let second = self.slots[first.next as usize];
        let wanted = steps - first_len;
        let available = usize::from(second.steps_len);
        if available >= wanted {
            let ends_there = available == wanted && second.terminated;
            window(wanted, first.next, ends_there)
        } else if second.terminated {
            window(available, first.next, true)
        } else {
            None
        }
    }

    /// Returns the window's first observation, (O,).
    #[must_use]
    pub fn observation(&self, window: &Window) -> &[f32] {
        self.observation_row(window.slot, usize::from(window.offset))
    }

    /// Returns the observation one step after the first, (O,).
    #[must_use]
    pub fn second_observation(&self, window: &Window) -> &[f32] {
        self.observation_row(window.slot, usize::from(window.offset) + 1)
    }

    /// Returns the observation after the window's last step, (O,).
    #[must_use]
    pub fn last_observation(&self, window: &Window) -> &[f32] {
        self.observation_after(window, window.len())
    }

    /// Returns the observation after the window's first `steps` steps, (O,).
    #[must_use]
    pub fn observation_after(&self, window: &Window, steps: usize) -> &[f32] {
        match steps.checked_sub(usize::from(window.first_len)) {
            Some(row) if row > 0 => self.observation_row(window.next, row),
            _ => self.observation_row(window.slot, usize::from(window.offset) + steps),
        }
    }

    pub(super) fn observation_row(&self, slot: u32, row: usize) -> &[f32] {
        let len = self.layout.observation_len;
        let (observations, _, _) = self.layout.split(self.block(slot as usize));
        &observations[row * len..(row + 1) * len]
    }

    /// Returns the observation after a slot's last step, (O,).
    pub(super) fn last_row(&self, slot: u32) -> &[f32] {
        self.observation_row(slot, usize::from(self.slots[slot as usize].steps_len))
    }

    /// Copies the window's actions, (n, A), to the front of `out`, (K, A), and zeros the rest.
    pub fn actions(&self, window: &Window, out: &mut [f32]) {
        let dims = self.layout.action_len;
        let (first, second) = self.parts(window, |(_, actions, _)| actions, dims);
        out[..first.len()].copy_from_slice(first);
        out[first.len()..first.len() + second.len()].copy_from_slice(second);
        out[first.len() + second.len()..].fill(0.0);
    }

    /// Returns the two actions before the window's first, u_{t-2} and u_{t-1}, (A,) each, or `None`
    /// where the episode began later or the replay no longer has the segment. Without u_{t-1} there
    /// is no u_{t-2} either.
    #[must_use]
    pub fn previous_actions(&self, window: &Window) -> [Option<&[f32]>; 2] {
        let last = self.step_before(window.slot, window.offset.into());
        let last_but_one = last.and_then(|(slot, step)| self.step_before(slot, step));
        [last_but_one, last].map(|at| {
            let (slot, step) = at?;
            let (_, actions, _) = self.layout.split(self.block(slot as usize));
            actions.chunks_exact(self.layout.action_len).nth(step)
        })
    }

    /// Returns the observation before the window's first one, (O,), or `None` where there is no
    /// action before it.
    pub(super) fn observation_before(&self, window: &Window) -> Option<&[f32]> {
        let (slot, step) = self.step_before(window.slot, window.offset.into())?;
        Some(self.observation_row(slot, step))
    }

    /// Returns slot and step before those of a step in the same episode.
    fn step_before(&self, slot: u32, step: usize) -> Option<(u32, usize)> {
        if let Some(step) = step.checked_sub(1) {
            return Some((slot, step));
        }
        let previous = self.slots[slot as usize].previous;
        let before = self.slots.get(previous as usize)?;
        // A slot that has been replaced since does not continue here.
        (before.next == slot).then(|| (previous, usize::from(before.steps_len).saturating_sub(1)))
    }

    /// Returns the sum of discount^i r_i over the window's n steps.
    #[must_use]
    pub fn discounted_reward(&self, window: &Window, discount: f32) -> f32 {
        let (first, second) = self.parts(window, |(_, _, rewards)| rewards, 1);
        second.iter().rev().chain(first.iter().rev()).fold(0.0, |sum, r| r + discount * sum)
    }

    /// Returns the reward of the window's last step.
    #[must_use]
    pub fn last_reward(&self, window: &Window) -> f32 {
        let (first, second) = self.parts(window, |(_, _, rewards)| rewards, 1);
        second.last().or(first.last()).copied().unwrap_or(0.0)
    }

    /// Returns true if the episode reached its time limit at the window's last step.
    #[must_use]
    pub fn ends_at_time_limit(&self, window: &Window) -> bool {
        let Window { slot, offset, first_len, second_len, next, .. } = *window;
        let (last, end) =
            if second_len > 0 { (next, second_len) } else { (slot, offset + first_len) };
        let last = self.slots[last as usize];
        last.truncated && last.steps_len == end
    }

    /// Returns the window's rows of one part of the blocks, with `width` numbers per step, from the
    /// first and from the second slot.
    fn parts<'a>(
        &'a self,
        window: &Window,
        part: impl Fn((&'a [f32], &'a [f32], &'a [f32])) -> &'a [f32],
        width: usize,
    ) -> (&'a [f32], &'a [f32]) {
        let from = usize::from(window.offset) * width;
        let first = part(self.layout.split(self.block(window.slot as usize)));
        let first = &first[from..from + usize::from(window.first_len) * width];
        if window.second_len == 0 {
            return (first, &[]);
        }
        let second = part(self.layout.split(self.block(window.next as usize)));
        (first, &second[..usize::from(window.second_len) * width])
    }
}

#[cfg(test)]
pub(super) mod tests {
    use dmprl_shared::segment::{HINDSIGHT, SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED};

    use super::*;

    pub(in crate::replay) const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 3, observation_len: 1, action_len: 1 };

    /// Inserts an episode e in which step t has observation 100 e + t, action t / 100 and reward t.
    pub(in crate::replay) fn episode(replay: &mut Replay, episode: u32, steps: u32, flag: u32) {
        for start in (0..steps).step_by(3) {
            let len = (steps - start).min(3);
            let mut block = vec![0.0; LAYOUT.block_len()];
            let (observations, actions, rewards) = LAYOUT.split_mut(&mut block);
            for k in 0..len as usize {
                let t = (start as usize + k) as f32;
                observations[k] = 100.0 * episode as f32 + t;
                actions[k] = t / 100.0;
                rewards[k] = t;
            }
            observations[len as usize] = (100 * episode + start + len) as f32;
            let header = SegmentHeader {
                episode,
                episode_step: start,
                steps_len: len,
                flags: if start + len == steps { flag } else { 0 },
                ..SegmentHeader::default()
            };
            replay.insert(&header, &block);
        }
    }

    fn starts(replay: &Replay) -> Vec<(f32, usize, bool)> {
        let mut all = Vec::new();
        for slot in 0..replay.len() {
            for offset in 0..3 {
                if let Some(window) = replay.window(slot, offset) {
                    all.push((replay.observation(&window)[0], window.len(), window.terminated));
                }
            }
        }
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all
    }

    #[test]
    fn windows_of_a_truncated_episode_are_all_whole() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 8, TRUNCATED);
        let expected: Vec<_> = (0..=5).map(|t| (t as f32, 3, false)).collect();
        assert_eq!(starts(&replay), expected);
    }

    #[test]
    fn windows_of_a_terminated_episode_run_short_at_its_end() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 8, TERMINATED);
        let expected: Vec<_> = (0..8).map(|t| (t as f32, (8 - t).min(3), t + 3 >= 8)).collect();
        assert_eq!(starts(&replay), expected);
    }

    #[test]
    fn no_window_crosses_from_one_episode_to_the_next() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 6, TRUNCATED);
        episode(&mut replay, 1, 6, TRUNCATED);
        let firsts: Vec<f32> = starts(&replay).iter().map(|start| start.0).collect();
        assert_eq!(firsts, [0.0, 1.0, 2.0, 3.0, 100.0, 101.0, 102.0, 103.0]);
    }

    #[test]
    fn a_sliding_window_reads_over_the_border_of_its_slot() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 2, 9, TRUNCATED);
        let window = replay.window(0, 2).unwrap();
        let mut actions = [9.0; 3];
        replay.actions(&window, &mut actions);
        assert_eq!(actions, [0.02, 0.03, 0.04]);
        assert_eq!(replay.last_observation(&window), [205.0]);
        assert_eq!(replay.second_observation(&window), [203.0]);
        // 2 + 0.5 * 3 + 0.25 * 4
        assert_eq!(replay.discounted_reward(&window, 0.5), 4.5);
    }

    #[test]
    fn the_window_that_ends_at_the_time_limit_is_known() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 8, TRUNCATED);
        episode(&mut replay, 1, 9, TRUNCATED);
        episode(&mut replay, 2, 6, TERMINATED);
        let windows = (0..replay.len()).flat_map(|slot| (0..3).map(move |at| (slot, at)));
        let windows = windows.filter_map(|(slot, offset)| replay.window(slot, offset));
        let last = windows.filter(|window| replay.ends_at_time_limit(window));
        let last: Vec<_> =
            last.map(|it| (replay.observation(&it)[0], replay.last_reward(&it))).collect();
        assert_eq!(last, [(5.0, 7.0), (106.0, 8.0)]);
    }

    #[test]
    fn missing_actions_of_a_terminated_window_are_zero() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 5, TERMINATED);
        let window = replay.window(1, 1).unwrap();
        let mut actions = [9.0; 3];
        replay.actions(&window, &mut actions);
        assert_eq!((actions, window.len(), window.terminated), ([0.04, 0.0, 0.0], 1, true));
        assert_eq!(replay.last_observation(&window), [5.0]);
    }

    #[test]
    fn a_wrapped_ring_holds_the_newest_and_bridges_nothing() {
        let mut replay = Replay::new(LAYOUT, 12, 1, 1); // 4 slots
        episode(&mut replay, 0, 9, TRUNCATED);
        episode(&mut replay, 1, 9, TRUNCATED); // replaces the first two slots of episode 0
        assert_eq!(replay.len(), 4);
        let firsts: Vec<f32> = starts(&replay).iter().map(|start| start.0).collect();
        assert_eq!(firsts, [6.0, 100.0, 101.0, 102.0, 103.0, 104.0, 105.0, 106.0]);
    }

    /// Returns (observation, the two previous actions) of every window.
    fn previous(replay: &Replay) -> Vec<(f32, [Option<f32>; 2])> {
        let windows = (0..replay.len()).flat_map(|slot| (0..3).map(move |at| (slot, at)));
        let windows = windows.filter_map(|(slot, offset)| replay.window(slot, offset));
        let mut all: Vec<_> = windows
            .map(|window| {
                let previous = replay.previous_actions(&window);
                (replay.observation(&window)[0], previous.map(|action| Some(action?[0])))
            })
            .collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all
    }

    #[test]
    fn the_action_before_a_window_is_that_of_its_own_episode() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 6, TERMINATED);
        episode(&mut replay, 1, 3, TRUNCATED);
        let all = [None, None, Some(0.0), Some(0.01), Some(0.02), Some(0.03), Some(0.04)];
        let expected = all.windows(2).map(|pair| [pair[0], pair[1]]).chain([[None; 2]]);
        let (steps, actions): (Vec<_>, Vec<_>) = previous(&replay).into_iter().unzip();
        assert_eq!(
            (steps, actions),
            ((0..6).map(|t| t as f32).chain([100.0]).collect(), expected.collect())
        );
    }

    #[test]
    fn no_action_comes_before_a_window_whose_predecessor_was_replaced() {
        let mut replay = Replay::new(LAYOUT, 12, 1, 1); // 4 slots
        episode(&mut replay, 0, 9, TRUNCATED);
        // Replaces the first two slots of episode 0; the last one's predecessor is gone.
        episode(&mut replay, 1, 9, TRUNCATED);
        let of = |step| previous(&replay).into_iter().find(|found| found.0 == step).unwrap().1;
        assert_eq!(
            (of(6.0), of(100.0), of(103.0), of(106.0)),
            ([None; 2], [None; 2], [Some(0.01), Some(0.02)], [Some(0.04), Some(0.05)])
        );
    }

    #[test]
    fn a_replay_read_from_a_file_knows_the_actions_before_too() {
        let mut replay = Replay::new(LAYOUT, 12, 1, 1);
        episode(&mut replay, 0, 9, TRUNCATED);
        episode(&mut replay, 1, 9, TRUNCATED);
        let mut bytes = Vec::new();
        replay.write(&mut bytes).unwrap();
        let mut read = Replay::new(LAYOUT, 12, 1, 1);
        read.read(&mut bytes.as_slice()).unwrap();
        assert_eq!(previous(&read), previous(&replay));
    }

    #[test]
    fn a_lost_segment_breaks_the_chain() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        let block = vec![0.0; LAYOUT.block_len()];
        for start in [0, 6] {
            let header =
                SegmentHeader { episode_step: start, steps_len: 3, ..SegmentHeader::default() };
            replay.insert(&header, &block);
        }
        assert!(replay.window(0, 0).is_some() && replay.window(0, 1).is_none());
    }

    #[test]
    fn segments_of_other_environments_may_come_in_between() {
        let mut replay = Replay::new(LAYOUT, 300, 2, 2);
        let block = vec![0.0; LAYOUT.block_len()];
        for start in [0, 3] {
            for (worker_id, env_index) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let header = SegmentHeader {
                    worker_id,
                    env_index,
                    episode_step: start,
                    steps_len: 3,
                    ..SegmentHeader::default()
                };
                replay.insert(&header, &block);
            }
        }
        assert!((0..4).all(|slot| replay.window(slot, 2).is_some_and(|window| window.len() == 3)));
    }

    /// Inserts a hindsight copy.
    pub(in crate::replay) fn copy(replay: &mut Replay, episode_step: u32) {
        let header = SegmentHeader {
            flags: HINDSIGHT,
            steps_len: 3,
            episode_step,
            ..SegmentHeader::default()
        };
        replay.insert(&header, &vec![0.5; LAYOUT.block_len()]);
    }

    #[test]
    fn a_copy_with_another_goal_continues_nothing_and_nothing_continues_it() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        let block = vec![0.0; LAYOUT.block_len()];
        for start in [0, 3, 6] {
            let header =
                SegmentHeader { episode_step: start, steps_len: 3, ..SegmentHeader::default() };
            replay.insert(&header, &block);
            // At the step at which the episode's next segment is expected.
            copy(&mut replay, start + 3);
        }
        for (slot, real) in [true, false, true, false].into_iter().enumerate() {
            let whole = replay.window(slot, 0).unwrap();
            assert_eq!(whole.len(), 3);
            assert_eq!(
                replay.previous_actions(&whole)[1].is_some(),
                real && slot > 0,
                "slot {slot}"
            );
            assert_eq!(replay.window(slot, 1).is_some(), real, "slot {slot}");
            if let Some(window) = replay.window(slot, 1) {
                assert_eq!(window.next, slot as u32 + 2, "the segment, not the copy between");
            }
        }
    }
}
