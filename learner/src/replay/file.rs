//! Reads and writes the replay of a checkpoint, a binary file with checked lengths.
//!
//! ```text
//!   magic "DMPRLRP2" · u64 K, O, A, slot count, filled, head, inserted, tail count, kept
//!   then slots · tails · blocks:
//!   slot: u32 next, u8 steps_len, u8 terminated, u8 truncated, u8 hindsight     (filled ones)
//!   tail: u32 slot, incarnation, episode, episode_steps, u64 number; slot = 2^32 - 1: none
//!   block: f32 × block_len (filled ones)                                 all little-endian
//! ```
//! `kept` is the number of demonstrated segments. "DMPRLRP1", of older versions, has no such field.
//!
//! Nothing in the file is trusted: counts are compared with the configuration before anything else
//! is read, and every slot number must be below `filled`.

use std::io::{self, Read, Write};

use dmprl_shared::segment::SegmentLayout;
use thiserror::Error;

use super::{NONE, Place, Replay, Slot, Tail};

const MAGIC: &[u8; 8] = b"DMPRLRP2";
const MAGIC_WITHOUT_KEPT: &[u8; 8] = b"DMPRLRP1";
/// Larger counts of insertions are rejected.
const INSERTED_MAX: u64 = 1 << 62;

/// Why a replay file was rejected.
#[derive(Debug, Error)]
pub enum ReplayFileError {
    /// Reading or writing failed, or the file ends early.
    #[error("replay file: {0}")]
    Io(#[from] io::Error),
    /// The file is not a replay file.
    #[error("replay file: expected DMPRLRP2 at the start, got {0:?}")]
    Magic([u8; 8]),
    /// A count does not match the configuration.
    #[error("replay file: {name} is {got}, the configuration gives {expected}")]
    Count {
        /// Name of the count.
        name: &'static str,
        /// Value from the configuration.
        expected: u64,
        /// Value in the file.
        got: u64,
    },
    /// The fields of a slot or tail contradict each other.
    #[error("replay file: {name} {index} is inconsistent")]
    Inconsistent {
        /// Slot or tail.
        name: &'static str,
        /// Its index.
        index: usize,
    },
}

impl Replay {
    fn counts(&self) -> [(&'static str, u64); 4] {
        let SegmentLayout { segment_steps, observation_len, action_len } = self.layout;
        [
            ("segment_steps", segment_steps as u64),
            ("observation_len", observation_len as u64),
            ("action_len", action_len as u64),
            ("slot count", self.slots.len() as u64),
        ]
    }

    /// Writes the replay for [`Replay::read`].
    ///
    /// # Errors
    /// If writing fails.
    pub fn write(&self, out: &mut impl Write) -> Result<(), ReplayFileError> {
        out.write_all(MAGIC)?;
        let sizes = [self.filled as u64, self.head as u64, self.inserted, self.tails.len() as u64];
        let sizes = sizes.into_iter().chain([self.demonstrations as u64]);
        for count in self.counts().iter().map(|(_, count)| *count).chain(sizes) {
            out.write_all(&count.to_le_bytes())?;
        }
        for slot in &self.slots[..self.filled] {
            out.write_all(&slot.next.to_le_bytes())?;
            let flags = [slot.terminated, slot.truncated, slot.hindsight].map(u8::from);
            out.write_all(&[slot.steps_len, flags[0], flags[1], flags[2]])?;
        }
        for tail in &self.tails {
            let (words, number) = match tail {
                Some(t) => ([t.slot, t.incarnation, t.episode, t.episode_steps], t.number),
                None => ([NONE, 0, 0, 0], 0),
            };
            for word in words {
                out.write_all(&word.to_le_bytes())?;
            }
            out.write_all(&number.to_le_bytes())?;
        }
        // Every supported processor is little-endian.
        for numbers in self.blocks.first(self.filled) {
            out.write_all(bytemuck::cast_slice(numbers))?;
        }
        Ok(())
    }

    /// Reads a file into this replay, which must be new.
    ///
    /// # Errors
    /// If the file is not a replay file, is truncated or does not match the configuration. The
    /// replay is then unusable.
    pub fn read(&mut self, input: &mut impl Read) -> Result<(), ReplayFileError> {
        let mut magic = [0; 8];
        input.read_exact(&mut magic)?;
        if &magic != MAGIC && &magic != MAGIC_WITHOUT_KEPT {
            return Err(ReplayFileError::Magic(magic));
        }
        for (name, expected) in self.counts() {
            match read_u64(input)? {
                got if got == expected => {}
                got => return Err(ReplayFileError::Count { name, expected, got }),
            }
        }
        let max = self.slots.len() as u64;
        let [filled, head] = [("filled", max + 1), ("head", max)].map(|(name, limit)| {
            let got = read_u64(input)?;
            let fits = got < limit;
            fits.then_some(got as usize).ok_or(ReplayFileError::Count { name, expected: max, got })
        });
        (self.filled, self.head) = (filled?, head?);
        // A ring that is not full is filled from the front.
        if (self.filled as u64) < max && self.head != self.filled {
            return Err(ReplayFileError::Inconsistent { name: "head", index: self.head });
        }
        self.inserted = read_u64(input)?;
        if !(self.filled as u64..=INSERTED_MAX).contains(&self.inserted) {
            let index = self.filled;
            return Err(ReplayFileError::Inconsistent { name: "count of insertions at", index });
        }
        let tail_count = read_u64(input)?;
        self.demonstrations = if &magic == MAGIC { self.read_demonstrations(input)? } else { 0 };
        for index in 0..self.filled {
            self.slots[index] = self.read_slot(input, index)?;
        }
        for index in 0..self.filled {
            let next = self.slots[index].next;
            if next != NONE {
                self.slots[next as usize].previous = index as u32;
            }
        }
        self.rebuild_episodes();
        // The number of workers may have changed. Tails of workers that no longer exist are
        // ignored, because their episodes do not continue.
        for index in 0..tail_count as usize {
            let tail = self.read_tail(input, index)?;
            if let Some(own) = self.tails.get_mut(index) {
                *own = tail;
            }
        }
        for numbers in self.blocks.first_mut(self.filled) {
            input.read_exact(bytemuck::cast_slice_mut(numbers))?;
        }
        Ok(())
    }

    /// Reads the number of demonstrated segments, which are at the front of the ring.
    fn read_demonstrations(&self, input: &mut impl Read) -> Result<usize, ReplayFileError> {
        let (expected, got) = (self.filled.min(self.head) as u64, read_u64(input)?);
        if got > expected {
            return Err(ReplayFileError::Count { name: "kept", expected, got });
        }
        Ok(got as usize)
    }

    fn read_slot(&self, input: &mut impl Read, index: usize) -> Result<Slot, ReplayFileError> {
        let next = read_u32(input)?;
        let mut fields = [0; 4];
        input.read_exact(&mut fields)?;
        let [steps_len, flags @ ..] = fields;
        let sound = (1..=self.layout.segment_steps).contains(&usize::from(steps_len))
            && flags.iter().all(|&flag| flag <= 1)
            && (next == NONE || (next as usize) < self.filled);
        if !sound {
            return Err(ReplayFileError::Inconsistent { name: "slot", index });
        }
        let [terminated, truncated, hindsight] = flags.map(|flag| flag == 1);
        let place = Place::default();
        Ok(Slot { next, previous: NONE, steps_len, terminated, truncated, hindsight, place })
    }

    fn read_tail(
        &self,
        input: &mut impl Read,
        index: usize,
    ) -> Result<Option<Tail>, ReplayFileError> {
        let slot = read_u32(input)?;
        let [incarnation, episode, episode_steps] =
            [read_u32(input)?, read_u32(input)?, read_u32(input)?];
        let number = read_u64(input)?;
        if slot != NONE && (slot as usize >= self.filled || number >= self.inserted) {
            return Err(ReplayFileError::Inconsistent { name: "tail", index });
        }
        Ok((slot != NONE).then_some(Tail { slot, number, incarnation, episode, episode_steps }))
    }
}

fn read_u64(input: &mut impl Read) -> io::Result<u64> {
    let mut bytes = [0; 8];
    input.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}

fn read_u32(input: &mut impl Read) -> io::Result<u32> {
    let mut bytes = [0; 4];
    input.read_exact(&mut bytes)?;
    Ok(u32::from_le_bytes(bytes))
}

#[cfg(test)]
mod tests {
    use dmprl_shared::segment::{HINDSIGHT, SegmentHeader};

    use super::*;

    const LAYOUT: SegmentLayout =
        SegmentLayout { segment_steps: 3, observation_len: 2, action_len: 1 };

    fn filled() -> Replay {
        let mut replay = Replay::new(LAYOUT, 30, 1, 2);
        for i in 0..14_u32 {
            let block: Vec<f32> =
                (0..LAYOUT.block_len()).map(|j| (i * 100) as f32 + j as f32).collect();
            let header = SegmentHeader {
                flags: if i % 5 == 4 { HINDSIGHT } else { 0 },
                env_index: i % 2,
                episode_step: i / 2 * 3,
                steps_len: 3,
                ..SegmentHeader::default()
            };
            replay.insert(&header, &block);
        }
        replay
    }

    fn bytes(replay: &Replay) -> Vec<u8> {
        let mut bytes = Vec::new();
        replay.write(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn a_replay_read_back_is_the_same() {
        let written = bytes(&filled());
        let mut replay = Replay::new(LAYOUT, 30, 1, 2);
        replay.read(&mut written.as_slice()).unwrap();
        assert_eq!(bytes(&replay), written);
    }

    #[test]
    fn every_truncation_is_refused() {
        let written = bytes(&filled());
        for len in 0..written.len() {
            let mut replay = Replay::new(LAYOUT, 30, 1, 2);
            assert!(replay.read(&mut &written[..len]).is_err(), "{len} bytes");
        }
    }

    #[test]
    fn a_replay_of_other_sizes_is_refused_by_name() {
        let written = bytes(&filled());
        let other = SegmentLayout { observation_len: 3, ..LAYOUT };
        let error = Replay::new(other, 30, 1, 2).read(&mut written.as_slice()).unwrap_err();
        assert!(error.to_string().contains("observation_len is 2, the configuration gives 3"));
        let error = Replay::new(LAYOUT, 60, 1, 2).read(&mut written.as_slice()).unwrap_err();
        assert!(error.to_string().contains("slot count is 10, the configuration gives 20"));
    }

    #[test]
    fn a_replay_of_fewer_or_more_workers_is_read() {
        let written = bytes(&filled());
        for workers in [2, 3] {
            let mut more = Replay::new(LAYOUT, 30, workers, 2);
            more.read(&mut written.as_slice()).unwrap();
            assert!(more.tails[..2].iter().all(Option::is_some));
            assert!(more.tails[2..].iter().all(Option::is_none));
            let mut fewer = Replay::new(LAYOUT, 30, 1, 2);
            fewer.read(&mut bytes(&more).as_slice()).unwrap();
            assert_eq!(bytes(&fewer), written);
        }
    }

    #[test]
    fn flipped_bytes_never_panic_or_point_outside() {
        let written = bytes(&filled());
        for at in 0..written.len() {
            let mut damaged = written.clone();
            damaged[at] ^= 0xff;
            let mut replay = Replay::new(LAYOUT, 30, 1, 2);
            if replay.read(&mut damaged.as_slice()).is_ok() {
                for slot in 0..replay.len() {
                    for offset in 0..3 {
                        if let Some(window) = replay.window(slot, offset) {
                            let _ = replay.last_observation(&window);
                        }
                    }
                }
            }
        }
    }
}
