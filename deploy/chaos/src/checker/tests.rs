//! Tests the checker with hand-written journals: a correct one, and one for each kind of violation.

use dmprl_shared::transport::delivery::Watermark;

use super::*;

const INTERVAL: u64 = 100;
const STEPS: u64 = 5;

/// Writes the journals of a run with two workers, as a real run would.
struct JournalScript {
    checker: Checker,
    learner: Author,
}

fn mark(incarnation: u32, sequence: u64) -> Watermark {
    Watermark { incarnation, sequence }
}

fn digest(worker: u32, mark: Watermark) -> SegmentDigest {
    SegmentDigest { worker, mark, checksum: worker ^ mark.sequence as u32, env_steps: STEPS }
}

fn counters_after(segments: u64) -> LearnerCounters {
    LearnerCounters { env_steps: segments * STEPS, updates: 2 * segments, segments }
}

impl JournalScript {
    /// Creates a run whose learner starts without a checkpoint.
    fn new() -> Self {
        let mut script = Self { checker: Checker::new(2, INTERVAL), learner: Author::Learner(0) };
        script.start_learner(0, [mark(0, 0), mark(0, 0)], 0);
        script
    }

    fn note(&mut self, author: Author, entry: Entry) {
        self.checker.process(author, &Record { entry, time_us: 0 });
    }

    fn note_learner(&mut self, entry: Entry) {
        self.note(self.learner, entry);
    }

    /// Starts a learner from a checkpoint with these marks and this number of segments.
    fn start_learner(&mut self, deaths: u64, marks: [Watermark; 2], segments: u64) {
        self.restore_learner(deaths, marks, segments);
        self.note_learner(Entry::Serving);
    }

    /// Starts a learner, which has yet to read its log.
    fn restore_learner(&mut self, deaths: u64, marks: [Watermark; 2], segments: u64) {
        self.learner = Author::Learner(deaths);
        for (worker, mark) in (0..).zip(marks) {
            self.note_learner(Entry::Restored(worker, mark));
        }
        self.note_learner(Entry::Started(counters_after(segments)));
    }

    fn produce(&mut self, worker: u32, incarnation: u32, sequences: std::ops::RangeInclusive<u64>) {
        for sequence in sequences {
            let segment = digest(worker, mark(incarnation, sequence));
            self.note(Author::Worker(worker, incarnation), Entry::Produced(segment));
        }
    }

    fn insert(&mut self, worker: u32, incarnation: u32, sequences: std::ops::RangeInclusive<u64>) {
        for sequence in sequences {
            self.note_learner(Entry::Inserted(digest(worker, mark(incarnation, sequence))));
        }
    }

    fn acknowledge(&mut self, worker: u32, mark: Watermark) {
        self.note(Author::Worker(worker, mark.incarnation), Entry::Acknowledged(mark));
    }

    /// Creates a run that has inserted the first ten segments of each worker.
    fn with_ten_of_each() -> Self {
        let mut script = Self::new();
        for worker in [0, 1] {
            script.produce(worker, 0, 1..=10);
            script.insert(worker, 0, 1..=10);
        }
        script
    }

    fn end(mut self) -> (SegmentTotals, Vec<String>) {
        let sums = self.checker.conclude();
        (sums, self.checker.violations.into_sentences())
    }

    /// Asserts that the run has exactly one violation, which is of this invariant.
    #[track_caller]
    fn expect_violation(self, invariant: &str, words: &str) -> SegmentTotals {
        let (sums, violations) = self.end();
        assert_eq!(violations.len(), 1, "{violations:#?}");
        assert!(violations[0].starts_with(invariant), "{violations:#?}");
        assert!(violations[0].contains(words), "{violations:#?}");
        sums
    }
}

/// After the deaths of a worker and of two learners, one with an incomplete checkpoint, only unsent
/// segments are missing.
#[test]
fn correct_run_has_no_violations() {
    let mut script = JournalScript::with_ten_of_each();
    script.acknowledge(0, mark(0, 8));
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.produce(0, 0, 11..=14);
    script.insert(0, 0, 11..=12);
    // Worker 0 dies with two unsent segments; its successor starts a new incarnation.
    script.produce(0, 1, 1..=3);
    script.insert(0, 1, 1..=2);
    script.note_learner(Entry::CheckpointBegun(counters_after(24)));
    // The learner dies before that checkpoint is complete. The log restores all segments except the
    // last one, which the worker retransmits together with an earlier one.
    script.start_learner(1, [mark(0, 10), mark(0, 10)], 20);
    script.insert(0, 0, 11..=12);
    script.insert(0, 1, 1..=1);
    script.note_learner(Entry::Rejected { segment: digest(0, mark(1, 1)), is_duplicate: true });
    script.insert(0, 1, 2..=3);
    script.acknowledge(0, mark(1, 3));
    script.note_learner(Entry::Rejected { segment: digest(0, mark(0, 13)), is_duplicate: true });
    script.start_learner(2, [mark(0, 10), mark(0, 10)], 20);
    script.insert(0, 0, 11..=12);
    script.insert(0, 1, 1..=3);
    let expected = SegmentTotals {
        produced: 27,
        inserted: 25,
        rejected: 0,
        in_flight: 2,
        lost: 0,
        duplicate: 2,
        acknowledged: 11,
    };
    assert_eq!(script.end(), (expected, Vec::new()));
}

#[test]
fn i1_a_lost_acknowledged_segment_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.produce(0, 0, 11..=15);
    script.insert(0, 0, 11..=15);
    script.acknowledge(0, mark(0, 15));
    // The log has lost the last two segments.
    script.start_learner(1, [mark(0, 10), mark(0, 10)], 20);
    script.insert(0, 0, 11..=13);
    let sums = script.expect_violation("I1", "2 segments of worker 0, incarnation 0, are lost");
    assert_eq!((sums.lost, sums.inserted, sums.in_flight), (2, 23, 0));
}

/// The segments were not acknowledged, but none may be skipped: the worker sends them in order and
/// retains them.
#[test]
fn i1_a_skipped_segment_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(1, 0, 11..=13);
    script.insert(1, 0, 11..=11);
    script.insert(1, 0, 13..=13);
    let sums = script.expect_violation("I1", "1 segments of worker 1");
    assert_eq!(sums.lost, 1);
}

#[test]
fn i1_marks_beyond_the_inserted_segments_are_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(0, 0, 11..=12);
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.start_learner(1, [mark(0, 12), mark(0, 10)], 20);
    let (_, violations) = script.end();
    assert!(violations[0].starts_with("I1: a learner resumes at"), "{violations:#?}");
}

#[test]
fn i1_a_decreasing_acknowledgement_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.acknowledge(0, mark(0, 8));
    script.acknowledge(0, mark(0, 7));
    script.expect_violation("I1", "acknowledged after 8");
}

#[test]
fn i2_a_segment_inserted_twice_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.insert(0, 0, 4..=4);
    script.expect_violation("I2", "segment 4 of worker 0");
}

/// Segments in a checkpoint count as inserted.
#[test]
fn i2_a_segment_inserted_again_after_a_restore_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.start_learner(1, [mark(0, 10), mark(0, 10)], 20);
    script.insert(1, 0, 10..=10);
    script.expect_violation("I2", "segment 10 of worker 1");
}

#[test]
fn i3_a_segment_out_of_order_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(0, 0, 11..=13);
    script.insert(0, 0, 12..=12);
    script.insert(0, 0, 11..=11);
    let (_, violations) = script.end();
    assert!(violations[0].starts_with("I3: segment 11 of worker 0"), "{violations:#?}");
}

#[test]
fn i3_a_segment_after_one_of_a_later_incarnation_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(0, 0, 11..=11);
    script.produce(0, 1, 1..=1);
    script.insert(0, 1, 1..=1);
    script.insert(0, 0, 11..=11);
    script.expect_violation("I3", "segment 11 of worker 0, incarnation 0");
}

#[test]
fn i4_a_changed_payload_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(0, 0, 11..=11);
    let changed = SegmentDigest { checksum: 0xbad, ..digest(0, mark(0, 11)) };
    script.note_learner(Entry::Inserted(changed));
    script.expect_violation("I4", "checksum 0x00000bad");
}

#[test]
fn i5_a_rollback_by_two_checkpoints_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.produce(0, 0, 11..=20);
    script.insert(0, 0, 11..=20);
    script.note_learner(Entry::CheckpointBegun(counters_after(30)));
    script.note_learner(Entry::CheckpointBegun(counters_after(30)));
    script.start_learner(1, [mark(0, 10), mark(0, 10)], 20);
    script.insert(0, 0, 11..=20);
    script.expect_violation("I5", "went back 2 checkpoints");
}

/// A checkpoint whose counters and marks were taken at different times.
#[test]
fn i5_counters_that_contradict_the_marks_are_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.start_learner(1, [mark(0, 10), mark(0, 9)], 20);
    script.insert(1, 0, 10..=10);
    script.expect_violation("I5", "counts 20 segments, its marks 19");
}

#[test]
fn i5_counters_of_no_checkpoint_are_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.note_learner(Entry::CheckpointBegun(counters_after(20)));
    script.learner = Author::Learner(1);
    for worker in [0, 1] {
        script.note_learner(Entry::Restored(worker, mark(0, 10)));
    }
    script.note_learner(Entry::Started(LearnerCounters { updates: 7, ..counters_after(20) }));
    script.expect_violation("I5", "which no checkpoint has");
}

#[test]
fn i5_missing_checkpoints_are_found() {
    let mut script = JournalScript::new();
    let segments = (2 * INTERVAL + SEGMENT_STEPS) / STEPS + 1;
    script.produce(0, 0, 1..=segments);
    script.insert(0, 0, 1..=segments);
    script.expect_violation("I5", "no checkpoint was begun within 300 steps");
}

/// If each learner dies before its first checkpoint is written, the log gets longer than the limit.
#[test]
fn i5_segments_read_from_the_log_need_no_checkpoint() {
    let mut script = JournalScript::new();
    let segments = 2 * INTERVAL / STEPS;
    script.produce(0, 0, 1..=2 * segments);
    script.insert(0, 0, 1..=segments);
    script.restore_learner(1, [mark(0, 0), mark(0, 0)], 0);
    script.insert(0, 0, 1..=segments);
    script.note_learner(Entry::Serving);
    script.insert(0, 0, segments + 1..=2 * segments);
    script.restore_learner(2, [mark(0, 0), mark(0, 0)], 0);
    script.insert(0, 0, 1..=2 * segments);
    script.note_learner(Entry::Serving);
    assert_eq!(script.end().1, Vec::<String>::new());
}

#[test]
fn i6_a_decreasing_policy_version_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    for version in [4, 5, 4] {
        script.note(Author::Worker(0, 0), Entry::Policy { epoch: 1, version });
    }
    script.expect_violation("I6", "from policy 5 to 4 in epoch 1");
}

#[test]
fn i6_a_decreasing_epoch_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.note(Author::Worker(0, 0), Entry::Policy { epoch: 2, version: 9 });
    script.note(Author::Worker(0, 1), Entry::Policy { epoch: 1, version: 10 });
    script.expect_violation("I6", "from epoch 2 to 1");
}

#[test]
fn i9_a_segment_never_produced_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.insert(1, 0, 11..=11);
    let (_, violations) = script.end();
    assert!(violations[0].starts_with("I9: segment 11 of worker 1"), "{violations:#?}");
}

#[test]
fn i9_a_skipped_sequence_number_is_found() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(0, 0, 12..=12);
    let (_, violations) = script.end();
    assert!(violations[0].starts_with("I9: worker 0, incarnation 0, produced segment 12"));
}

/// A permanently rejected segment does not count as lost.
#[test]
fn i9_a_rejected_segment_is_counted_but_not_lost() {
    let mut script = JournalScript::with_ten_of_each();
    script.produce(0, 0, 11..=12);
    script.note_learner(Entry::Rejected { segment: digest(0, mark(0, 11)), is_duplicate: false });
    script.insert(0, 0, 12..=12);
    script.acknowledge(0, mark(0, 12));
    let (sums, violations) = script.end();
    assert_eq!((sums.rejected, sums.inserted, sums.lost), (1, 21, 0), "{violations:?}");
    assert_eq!(violations, Vec::<String>::new());
}
