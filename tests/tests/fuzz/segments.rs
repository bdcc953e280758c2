//! Arbitrary segments from a peer, given to the learner directly and through shared memory.

use std::fs::{self, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use dmprl_learner::learner::Learner;
use dmprl_shared::segment::{
    HINDSIGHT, LAYOUT_VERSION, Segment, SegmentHeader, SegmentLayout, TERMINATED, TRUNCATED,
    block_checksum,
};
use dmprl_shared::transport::shared_memory::{Domain, LearnerEnd, Plan, WorkerEnd, attach, serve};
use dmprl_shared::transport::{SegmentReceiver, SegmentSender, SendOutcome, TransportError};

use crate::fixture::{self, ENVS, RUN_ID, WORKERS};
use crate::mutate::Random;
use crate::{Target, Verdict};

/// Changes a valid segment: a header field to an edge value, single bits, or numbers of the block.
fn damage(random: &mut Random, segment: &mut Segment) {
    for _ in 0..random.below(3) {
        let header: &mut [u32] =
            bytemuck::cast_slice_mut(bytemuck::bytes_of_mut(&mut segment.header));
        let word = random.below(header.len());
        match random.below(4) {
            0 => header[word] ^= 1 << random.below(32),
            1 => header[word] = random.below(12) as u32,
            2 => header[word] = header[word].wrapping_add(1),
            _ => header[word] = random.number() as u32,
        }
    }
    for _ in 0..random.below(3) {
        let at = random.below(segment.block.len());
        segment.block[at] = random.float();
    }
    if random.once_in(12) {
        segment.block.truncate(random.below(segment.block.len()));
    }
    if !random.once_in(6) {
        segment.header.checksum = block_checksum(&segment.block);
    }
}

/// Properties of every accepted segment, independent of the tested code.
fn assert_sound(segment: &Segment, layout: SegmentLayout, architecture_hash: u64) {
    let header = segment.header;
    let (_, actions, _) = layout.split(&segment.block);
    assert_eq!((header.layout_version, header.run_id), (LAYOUT_VERSION, RUN_ID));
    assert_eq!(header.architecture_hash, architecture_hash);
    assert_eq!(header.segment_steps as usize, layout.segment_steps);
    assert_eq!(header.observation_len as usize, layout.observation_len);
    assert_eq!(header.action_len as usize, layout.action_len);
    assert!(header.worker_id < WORKERS && header.env_index < ENVS && header.sequence > 0);
    assert!(header.steps_len >= 1 && header.steps_len <= header.segment_steps);
    assert!(u64::from(header.episode_step) + u64::from(header.steps_len) <= u64::from(u32::MAX));
    assert!(header.flags < 32);
    let ends = header.flags & (TERMINATED | TRUNCATED) != 0;
    assert!(ends || header.steps_len == header.segment_steps);
    let copy = header.flags & HINDSIGHT != 0;
    assert!(!copy || header.flags & !TERMINATED == HINDSIGHT, "{:b}", header.flags);
    assert_eq!(header.checksum, crc32fast::hash(bytemuck::cast_slice(&segment.block)));
    assert!(segment.block.iter().all(|value| value.is_finite()));
    assert!(actions.iter().all(|action| (-1.0..=1.0).contains(action)));
}

fn replay_bytes(learner: &Learner) -> Vec<u8> {
    let mut bytes = Vec::new();
    learner.replay.write(&mut bytes).unwrap();
    bytes
}

#[test]
fn the_learner_takes_what_is_sound_and_refuses_the_rest_unchanged() {
    let target = Target {
        name: "segments::the_learner_takes_what_is_sound_and_refuses_the_rest_unchanged",
        cases: 2_000,
        bytes_max: 1 << 20,
    };
    let keys = [("policy.normalise_observations", "true")];
    target.fuzz(|random| {
        let mut learner = fixture::learner(&keys).unwrap();
        let (layout, hash) = (learner.policy().layout(), learner.policy().architecture_hash());
        let mut segment = fixture::segment(random, &learner, 0);
        damage(random, &mut segment);
        let (replay, counters) = (replay_bytes(&learner), learner.counters);
        match learner.insert(&segment) {
            Ok(()) => {
                assert_sound(&segment, layout, hash);
                let mark = learner.inbox.settled()[segment.header.worker_id as usize];
                assert_eq!(mark.sequence, segment.header.sequence);
                assert_eq!((learner.replay.len(), learner.insert(&segment).is_err()), (1, true));
                Verdict::Accepted
            }
            Err(why) => {
                assert_eq!(replay_bytes(&learner), replay, "{why}");
                assert_eq!(learner.counters.env_steps, counters.env_steps);
                assert_eq!(learner.counters.segments, counters.segments);
                assert_eq!(learner.counters.rejected.of(why), counters.rejected.of(why) + 1);
                Verdict::Refused
            }
        }
    });
}

/// One worker's queue and the file with its segments.
struct Queue {
    learner: LearnerEnd,
    worker: WorkerEnd,
    data: PathBuf,
    // Last, because its folder is removed with its last user.
    _domain: Domain,
    _folder: tempfile::TempDir,
}

impl Queue {
    fn new(layout: SegmentLayout, architecture_hash: u64) -> Self {
        let folder = fixture::folder();
        let domain = Domain::create(&folder.path().join("p"), "run").unwrap();
        let plan = Plan {
            run_id: RUN_ID,
            architecture_hash,
            layout,
            worker_count: 1,
            queue_segments: 1,
            parameters_len: 1,
        };
        let mut learner = serve(domain.path(), &plan).unwrap();
        let mut worker = attach(domain.path(), &plan, 0).unwrap();
        // The file whose block no other file has.
        let marked = vec![0.812_345_7; layout.block_len()];
        let sent = worker.segments.try_send(&SegmentHeader::default(), &marked).unwrap();
        assert_eq!(sent, SendOutcome::Delivered);
        assert!(learner.segments.try_receive(&mut Segment::zeroed(layout)).unwrap());
        let data = files(domain.path()).into_iter().find(|path| places(path, &marked).is_some());
        Self { learner, worker, data: data.unwrap(), _domain: domain, _folder: folder }
    }
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        let kind = entry.file_type().unwrap();
        if kind.is_dir() {
            found.extend(files(&entry.path()));
        } else if kind.is_file() {
            found.push(entry.path());
        }
    }
    found
}

/// Position of a block in a file [bytes].
fn places(path: &Path, block: &[f32]) -> Option<usize> {
    let (bytes, block) = (fs::read(path).ok()?, bytemuck::cast_slice::<f32, u8>(block));
    bytes.windows(block.len()).position(|window| window == block)
}

/// Bytes of headers in front of a block, iceoryx2's and ours, including its lengths.
const HEADERS: usize = 160;

/// A peer changes a sample after sending it: its numbers, our header, or the middleware's fields
/// for sender and length.
#[test]
fn what_a_peer_writes_into_a_sample_harms_nobody() {
    let target = Target {
        name: "segments::what_a_peer_writes_into_a_sample_harms_nobody",
        cases: 2_000,
        bytes_max: 4 << 20,
    };
    let mut learner = fixture::learner(&[]).unwrap();
    let (layout, hash) = (learner.policy().layout(), learner.policy().architecture_hash());
    let mut queue = Queue::new(layout, hash);
    let mut number = 0;
    target.fuzz(|random| {
        learner.inbox.restore(&[]);
        let mut sent = fixture::segment(random, &learner, 0);
        // So that its position can be found.
        sent.block[0] = number as f32;
        number += 1;
        sent.header.checksum = block_checksum(&sent.block);
        let outcome = queue.worker.segments.try_send(&sent.header, &sent.block).unwrap();
        assert_eq!(outcome, SendOutcome::Delivered);
        let at = places(&queue.data, &sent.block).unwrap();
        let file = OpenOptions::new().write(true).open(&queue.data).unwrap();
        for _ in 0..random.below(4) {
            let end = at + sent.block.len() * size_of::<f32>();
            let from = at - HEADERS + random.below(end - (at - HEADERS));
            let bytes = random.number().to_le_bytes();
            let len = 1 + random.below((end - from).min(8));
            file.write_all_at(&bytes[..len], from as u64).unwrap();
        }
        let mut got = Segment::zeroed(layout);
        match queue.learner.segments.try_receive(&mut got) {
            Ok(true) => {
                assert_eq!(got.block.len(), layout.block_len());
                let taken = learner.insert(&got);
                if taken.is_ok() {
                    assert_sound(&got, layout, hash);
                }
                Verdict::of(&taken)
            }
            Ok(false) => Verdict::Refused,
            Err(TransportError::Length { expected, got }) => {
                assert_ne!(expected, got);
                Verdict::Refused
            }
            Err(error) => panic!("{error}"),
        }
    });
}
