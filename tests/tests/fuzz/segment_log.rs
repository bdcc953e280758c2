//! The segment log after a crash or on a faulty disk.

use std::fs;

use dmprl_learner::learner::Learner;
use dmprl_shared::segment::{Segment, SegmentHeader};
use dmprl_shared::transport::delivery::{LogError, LogIdentity, SegmentLog};

use crate::fixture::{self, RUN_ID};
use crate::mutate::{self, Random};
use crate::{Target, Verdict};

const HEAD_BYTES: usize = 32;
const FRAME_BYTES: usize = 8;
const RECORDS: u64 = 6;
const BYTES_MAX: u64 = 1 << 20;

fn open(path: &std::path::Path, learner: &Learner) -> Result<SegmentLog, LogError> {
    let policy = learner.policy();
    let architecture_hash = policy.architecture_hash();
    let identity = LogIdentity { run_id: RUN_ID, architecture_hash };
    SegmentLog::open(path, identity, policy.layout(), BYTES_MAX)
}

/// Bytes of a valid log.
fn written(random: &mut Random, path: &std::path::Path, learner: &Learner) -> Vec<u8> {
    let mut log = open(path, learner).unwrap();
    for number in 0..RECORDS {
        let Segment { header, block } = fixture::segment(random, learner, number);
        log.append(&header, &block);
    }
    log.write().unwrap();
    drop(log);
    let bytes = fs::read(path).unwrap();
    fs::remove_file(path).unwrap();
    bytes
}

/// Corrects the checksums of records that are otherwise complete.
fn repair(log: &mut [u8], record_bytes: usize) {
    for record in log.get_mut(HEAD_BYTES..).unwrap_or_default().chunks_exact_mut(record_bytes) {
        let (frame, payload) = record.split_at_mut(FRAME_BYTES);
        frame[4..].copy_from_slice(&crc32fast::hash(payload).to_le_bytes());
    }
}

#[test]
fn every_whole_record_is_read_and_the_rest_is_cut_off() {
    let target = Target {
        name: "segment_log::every_whole_record_is_read_and_the_rest_is_cut_off",
        cases: 900,
        // The log's buffers of 4 and 1 MiB, twice, and a learner.
        bytes_max: 16 << 20,
    };
    let folder = fixture::folder();
    let path = folder.path().join("log");
    let plain = fixture::learner(&[]).unwrap();
    let block_bytes = plain.policy().layout().block_len() * size_of::<f32>();
    let record_bytes = FRAME_BYTES + size_of::<SegmentHeader>() + block_bytes;
    target.fuzz(|random| {
        let (mut log, other) = (written(random, &path, &plain), written(random, &path, &plain));
        mutate::bytes(random, &mut log, &other);
        if !random.once_in(3) {
            repair(&mut log, record_bytes);
        }
        if random.once_in(2) {
            log.splice(..HEAD_BYTES.min(log.len()), other[..HEAD_BYTES].iter().copied());
        }
        fs::write(&path, &log).unwrap();
        let verdict = read(&path, &log, &plain);
        fs::remove_file(&path).unwrap();
        verdict
    });
}

fn read(path: &std::path::Path, log: &[u8], plain: &Learner) -> Verdict {
    let mut opened = match open(path, plain) {
        Ok(opened) => opened,
        Err(LogError::Foreign) => {
            assert_eq!(fs::read(path).unwrap(), log, "the log of another run is unchanged");
            return Verdict::Refused;
        }
        Err(error) => panic!("{error}"),
    };
    let mut payloads = Vec::new();
    let replayed = opened.replay(|segment| {
        payloads.extend_from_slice(bytemuck::bytes_of(&segment.header));
        payloads.extend_from_slice(bytemuck::cast_slice(&segment.block));
    });
    let replayed = replayed.unwrap();
    drop(opened);
    // Exactly the delivered records are in the file.
    let left = fs::read(path).unwrap();
    assert_eq!(left.len() as u64 + replayed.cut_bytes, log.len().max(HEAD_BYTES) as u64);
    if log.len() >= HEAD_BYTES {
        assert_eq!(left, log[..left.len()]);
    }
    let records = left[HEAD_BYTES..].len() / (replayed.records.max(1) as usize);
    let found = left[HEAD_BYTES..].chunks_exact(records.max(1));
    assert_eq!(
        found.flat_map(|record| &record[FRAME_BYTES..]).copied().collect::<Vec<_>>(),
        payloads
    );
    for record in left[HEAD_BYTES..].chunks_exact(records.max(1)) {
        let (frame, payload) = record.split_at(FRAME_BYTES);
        let expected = [payload.len() as u32, crc32fast::hash(payload)].map(u32::to_le_bytes);
        assert_eq!(frame, expected.as_flattened(), "delivered records are complete");
    }
    // The learner accepts the sound records once each, and continues.
    let mut learner = fixture::learner(&[]).unwrap();
    let again = learner.recover(open(path, plain).unwrap()).unwrap();
    assert_eq!((again.records, again.cut_bytes), (replayed.records, 0));
    assert!(learner.replay.len() as u64 <= replayed.records);
    learner.inbox.acknowledge().unwrap();
    assert_eq!(learner.inbox.logged(), (left.len() - HEAD_BYTES) as u64);
    if replayed.records > 0 { Verdict::Accepted } else { Verdict::Refused }
}
