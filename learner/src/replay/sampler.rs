//! Draws windows at random, a share of them from the demonstrations.

use dmprl_shared::config::Windows;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::{Replay, Window};

/// Draws after which the sampler concludes that the replay has no window.
const TRIES_MAX: usize = 100_000;

/// Draws windows, with replacement.
#[derive(Debug, Clone)]
pub struct Sampler {
    windows: Windows,
    /// Probability with which [`Sampler::draw_due_demonstration`] draws a window.
    demonstrated: f64,
    random: Xoshiro256PlusPlus,
}

impl Sampler {
    /// Makes a sampler with its own random stream, which does not prefer demonstrations.
    #[must_use]
    pub fn new(windows: Windows, random: Xoshiro256PlusPlus) -> Self {
        Self { windows, demonstrated: 0.0, random }
    }

    /// Sets the share of the windows that come from the demonstrations.
    #[must_use]
    pub fn with_demonstrated(self, share: f64) -> Self {
        Self { demonstrated: share, ..self }
    }

    /// Continues with the random stream of a checkpoint.
    pub fn restore(&mut self, random: Xoshiro256PlusPlus) {
        self.random = random;
    }

    /// Returns the random stream, for a checkpoint.
    #[must_use]
    pub fn random(&self) -> &Xoshiro256PlusPlus {
        &self.random
    }

    /// Returns the random stream, to draw a batch's noise.
    pub fn random_mut(&mut self) -> &mut Xoshiro256PlusPlus {
        &mut self.random
    }

    /// Returns true with the given probability.
    pub(super) fn flip(&mut self, probability: f64) -> bool {
        probability > 0.0 && self.random.random_bool(probability)
    }

    /// Draws one window, or returns `None` after `TRIES_MAX` draws without one.
    ///
    /// Steps that start no window are drawn again, so every window of an episode is equally likely.
    /// A hindsight copy is one window, which is drawn as often as the K windows of a segment. The
    /// share of copies among the samples therefore does not depend on `windows`.
    pub fn draw(&mut self, replay: &Replay) -> Option<Window> {
        self.draw_from(replay, replay.len())
    }

    /// Draws one window from the demonstrations with the configured probability. Returns `None`
    /// otherwise, and without demonstrations.
    pub fn draw_due_demonstration(&mut self, replay: &Replay) -> Option<Window> {
        let is_due = replay.demonstrations > 0 && self.flip(self.demonstrated);
        is_due.then(|| self.draw_demonstration(replay)).flatten()
    }

    /// Draws one window from the demonstrations.
    pub fn draw_demonstration(&mut self, replay: &Replay) -> Option<Window> {
        self.draw_from(replay, replay.demonstrations)
    }

    fn draw_from(&mut self, replay: &Replay, slots: usize) -> Option<Window> {
        if slots == 0 {
            return None;
        }
        (0..TRIES_MAX).find_map(|_| {
            let slot = self.random.random_range(0..slots as u32) as usize;
            self.draw_in(replay, slot)
        })
    }

    /// Draws one of the windows that may begin in a slot, or `None` if a drawn step begins none.
    pub(super) fn draw_in(&mut self, replay: &Replay, slot: usize) -> Option<Window> {
        let offset = match self.windows {
            Windows::Segment => 0,
            Windows::Sliding if replay.slots[slot].hindsight => 0,
            Windows::Sliding => {
                self.random.random_range(0..replay.layout().segment_steps as u32) as usize
            }
        };
        replay.window(slot, offset)
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::{SegmentHeader, TERMINATED};

    use super::super::window::tests::{LAYOUT, copy, episode};
    use super::*;

    #[test]
    fn a_copy_is_drawn_as_often_as_all_windows_of_a_segment() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 6, TERMINATED); // two segments, six windows
        copy(&mut replay, 0);
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let drawn = (0..9_000).filter(|_| sampler.draw(&replay).unwrap().slot == 2).count();
        // Binomial(9000, 1/3) has standard deviation 45; five of them are allowed.
        assert!(drawn.abs_diff(3_000) < 225, "{drawn}");
    }

    #[test]
    fn the_configured_share_comes_from_the_demonstrations() {
        let random = || dmprl_shared::seeds::stream(1, "test", 0);
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        let mut sampler = Sampler::new(Windows::Segment, random()).with_demonstrated(0.25);
        assert!(sampler.draw_due_demonstration(&replay).is_none(), "no demonstrations");
        assert!(sampler.random() == &random(), "a run without demonstrations draws as before");
        let header = SegmentHeader { steps_len: 3, flags: TERMINATED, ..SegmentHeader::default() };
        replay.insert_demonstration(&header, &vec![0.0; LAYOUT.block_len()]);
        episode(&mut replay, 0, 6, TERMINATED);
        let drawn: Vec<_> =
            (0..4_000).filter_map(|_| sampler.draw_due_demonstration(&replay)).collect();
        assert!(drawn.iter().all(|window| window.slot == 0));
        // Binomial(4000, 1/4) has standard deviation 27; five of them are allowed.
        assert!(drawn.len().abs_diff(1_000) < 137, "{}", drawn.len());
    }

    #[test]
    fn every_window_is_drawn_equally_often() {
        let mut replay = Replay::new(LAYOUT, 300, 1, 1);
        episode(&mut replay, 0, 8, TERMINATED);
        let random = dmprl_shared::seeds::stream(1, "test", 0);
        let mut sampler = Sampler::new(Windows::Sliding, random);
        let mut counts = [0_u32; 8];
        for _ in 0..8_000 {
            let window = sampler.draw(&replay).unwrap();
            counts[replay.observation(&window)[0] as usize] += 1;
        }
        // Binomial(8000, 1/8) has standard deviation 30; five of them are allowed.
        assert!(counts.iter().all(|&count| count.abs_diff(1_000) < 150), "{counts:?}");
    }
}
