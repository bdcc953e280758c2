//! Hand-written journals: a correct one, and one for each way in which a run can violate a
//! guarantee.

use dmprl_shared::transport::delivery::Watermark;

use super::*;

const INTERVAL: u64 = 100;
const STEPS: u64 = 5;

/// A run of two workers, which writes journals like a real one.
struct Story {
    checker: Checker,
    learner: Author,
}

fn piece(worker: u32, (incarnation, sequence): (u32, u64)) -> Piece {
    let mark = Watermark { incarnation, sequence };
    Piece { worker, mark, checksum: worker ^ sequence as u32, env_steps: STEPS }
}

fn standing(segments: u64) -> Standing {
    Standing { env_steps: segments * STEPS, updates: 2 * segments, segments }
}

impl Story {
    /// Creates a run with a new learner.
    fn new() -> Self {
        let mut story = Self { checker: Checker::new(2, INTERVAL), learner: Author::Learner(0) };
        story.begin(0, [(0, 0), (0, 0)], 0);
        story
    }

    fn note(&mut self, author: Author, entry: Entry) {
        self.checker.take(author, &Record { entry, time_us: 0 });
    }

    fn says(&mut self, entry: Entry) {
        self.note(self.learner, entry);
    }

    /// Starts another learner from a checkpoint with this number of segments and these marks.
    fn begin(&mut self, deaths: u64, marks: [(u32, u64); 2], segments: u64) {
        self.learner = Author::Learner(deaths);
        for (worker, (incarnation, sequence)) in (0..).zip(marks) {
            self.says(Entry::Restored(worker, Watermark { incarnation, sequence }));
        }
        self.says(Entry::Started(standing(segments)));
        self.says(Entry::Serving);
    }

    fn produce(&mut self, worker: u32, incarnation: u32, sequences: std::ops::RangeInclusive<u64>) {
        for sequence in sequences {
            let piece = piece(worker, (incarnation, sequence));
            self.note(Author::Worker(worker, incarnation), Entry::Produced(piece));
        }
    }

    fn insert(&mut self, worker: u32, incarnation: u32, sequences: std::ops::RangeInclusive<u64>) {
        for sequence in sequences {
            self.says(Entry::Inserted(piece(worker, (incarnation, sequence))));
        }
    }

    fn acknowledge(&mut self, worker: u32, (incarnation, sequence): (u32, u64)) {
        let mark = Watermark { incarnation, sequence };
        self.note(Author::Worker(worker, incarnation), Entry::Acknowledged(mark));
    }

    /// Creates a run that has inserted the first ten segments of both workers.
    fn with_ten_of_each() -> Self {
        let mut story = Self::new();
        for worker in [0, 1] {
            story.produce(worker, 0, 1..=10);
            story.insert(worker, 0, 1..=10);
        }
        story
    }

    fn end(mut self) -> (Sums, Vec<String>) {
        let sums = self.checker.conclude();
        (sums, self.checker.violations.into_sentences())
    }

    /// Asserts that the run has exactly one violation, of this invariant.
    #[track_caller]
    fn breaks(self, invariant: &str, words: &str) -> Sums {
        let (sums, violations) = self.end();
        assert_eq!(violations.len(), 1, "{violations:#?}");
        assert!(violations[0].starts_with(invariant), "{violations:#?}");
        assert!(violations[0].contains(words), "{violations:#?}");
        sums
    }
}

/// The deaths of a worker and of two learners, one with an incomplete checkpoint, only lose
/// segments that were never sent.
#[test]
fn a_run_that_keeps_its_promises_is_not_accused() {
    let mut story = Story::with_ten_of_each();
    story.acknowledge(0, (0, 8));
    story.says(Entry::Cut(standing(20)));
    story.produce(0, 0, 11..=14);
    story.insert(0, 0, 11..=12);
    // Worker 0 dies with two unsent segments; its successor starts a new incarnation.
    story.produce(0, 1, 1..=3);
    story.insert(0, 1, 1..=2);
    story.says(Entry::Cut(standing(24)));
    // The learner dies before that checkpoint is complete. The log restores all segments but the
    // last, which the worker retransmits together with one more.
    story.begin(1, [(0, 10), (0, 10)], 20);
    story.insert(0, 0, 11..=12);
    story.insert(0, 1, 1..=1);
    story.says(Entry::Refused(piece(0, (1, 1)), true));
    story.insert(0, 1, 2..=3);
    story.acknowledge(0, (1, 3));
    story.says(Entry::Refused(piece(0, (0, 13)), true));
    story.begin(2, [(0, 10), (0, 10)], 20);
    story.insert(0, 0, 11..=12);
    story.insert(0, 1, 1..=3);
    let expected = Sums {
        produced: 27,
        inserted: 25,
        rejected: 0,
        in_flight: 2,
        lost: 0,
        duplicate: 2,
        acknowledged: 11,
    };
    assert_eq!(story.end(), (expected, Vec::new()));
}

#[test]
fn i1_a_lost_segment_that_was_acknowledged_is_found() {
    let mut story = Story::with_ten_of_each();
    story.says(Entry::Cut(standing(20)));
    story.produce(0, 0, 11..=15);
    story.insert(0, 0, 11..=15);
    story.acknowledge(0, (0, 15));
    // The log has lost its last two segments.
    story.begin(1, [(0, 10), (0, 10)], 20);
    story.insert(0, 0, 11..=13);
    let sums = story.breaks("I1", "2 segments of worker 0, incarnation 0, are lost");
    assert_eq!((sums.lost, sums.inserted, sums.in_flight), (2, 23, 0));
}

/// These segments were not acknowledged, but the worker sends in order and retains them, so none
/// may be skipped.
#[test]
fn i1_a_segment_that_was_left_out_is_found() {
    let mut story = Story::with_ten_of_each();
    story.produce(1, 0, 11..=13);
    story.insert(1, 0, 11..=11);
    story.insert(1, 0, 13..=13);
    let sums = story.breaks("I1", "1 segments of worker 1");
    assert_eq!(sums.lost, 1);
}

#[test]
fn i1_marks_beyond_what_was_inserted_are_found() {
    let mut story = Story::with_ten_of_each();
    story.produce(0, 0, 11..=12);
    story.says(Entry::Cut(standing(20)));
    story.begin(1, [(0, 12), (0, 10)], 20);
    let (_, violations) = story.end();
    assert!(violations[0].starts_with("I1: a learner goes on from"), "{violations:#?}");
}

#[test]
fn i1_an_acknowledgement_that_goes_back_is_found() {
    let mut story = Story::with_ten_of_each();
    story.acknowledge(0, (0, 8));
    story.acknowledge(0, (0, 7));
    story.breaks("I1", "acknowledged after 8");
}

#[test]
fn i2_a_segment_inserted_twice_is_found() {
    let mut story = Story::with_ten_of_each();
    story.insert(0, 0, 4..=4);
    story.breaks("I2", "segment 4 of worker 0");
}

/// Segments in a checkpoint count as inserted.
#[test]
fn i2_a_segment_inserted_again_after_it_was_restored_is_found() {
    let mut story = Story::with_ten_of_each();
    story.says(Entry::Cut(standing(20)));
    story.begin(1, [(0, 10), (0, 10)], 20);
    story.insert(1, 0, 10..=10);
    story.breaks("I2", "segment 10 of worker 1");
}

#[test]
fn i3_a_segment_that_comes_after_a_later_one_is_found() {
    let mut story = Story::with_ten_of_each();
    story.produce(0, 0, 11..=13);
    story.insert(0, 0, 12..=12);
    story.insert(0, 0, 11..=11);
    let (_, violations) = story.end();
    assert!(violations[0].starts_with("I3: segment 11 of worker 0"), "{violations:#?}");
}

#[test]
fn i3_a_segment_of_a_dead_worker_after_one_of_its_successor_is_found() {
    let mut story = Story::with_ten_of_each();
    story.produce(0, 0, 11..=11);
    story.produce(0, 1, 1..=1);
    story.insert(0, 1, 1..=1);
    story.insert(0, 0, 11..=11);
    story.breaks("I3", "segment 11 of worker 0, incarnation 0");
}

#[test]
fn i4_a_payload_that_changed_on_its_way_is_found() {
    let mut story = Story::with_ten_of_each();
    story.produce(0, 0, 11..=11);
    let torn = Piece { checksum: 0xbad, ..piece(0, (0, 11)) };
    story.says(Entry::Inserted(torn));
    story.breaks("I4", "checksum 0x00000bad");
}

#[test]
fn i5_a_learner_that_goes_back_too_far_is_found() {
    let mut story = Story::with_ten_of_each();
    story.says(Entry::Cut(standing(20)));
    story.produce(0, 0, 11..=20);
    story.insert(0, 0, 11..=20);
    story.says(Entry::Cut(standing(30)));
    story.says(Entry::Cut(standing(30)));
    story.begin(1, [(0, 10), (0, 10)], 20);
    story.insert(0, 0, 11..=20);
    story.breaks("I5", "gone back 2 checkpoints");
}

/// A checkpoint whose counters and marks were taken at different times.
#[test]
fn i5_counters_that_do_not_fit_the_marks_are_found() {
    let mut story = Story::with_ten_of_each();
    story.says(Entry::Cut(standing(20)));
    story.begin(1, [(0, 10), (0, 9)], 20);
    story.insert(1, 0, 10..=10);
    story.breaks("I5", "counts 20 segments, its marks are of 19");
}

#[test]
fn i5_counters_that_no_checkpoint_had_are_found() {
    let mut story = Story::with_ten_of_each();
    story.says(Entry::Cut(standing(20)));
    story.learner = Author::Learner(1);
    let mark = Watermark { incarnation: 0, sequence: 10 };
    story.says(Entry::Restored(0, mark));
    story.says(Entry::Restored(1, mark));
    story.says(Entry::Started(Standing { updates: 7, ..standing(20) }));
    story.breaks("I5", "of which no checkpoint was made");
}

#[test]
fn i5_a_learner_that_makes_no_checkpoints_is_found() {
    let mut story = Story::new();
    let segments = (2 * INTERVAL + SEGMENT_STEPS) / STEPS + 1;
    story.produce(0, 0, 1..=segments);
    story.insert(0, 0, 1..=segments);
    story.breaks("I5", "no checkpoint was begun in 300 steps");
}

#[test]
fn i6_a_policy_older_than_the_one_before_is_found() {
    let mut story = Story::with_ten_of_each();
    for version in [4, 5, 4] {
        story.note(Author::Worker(0, 0), Entry::Policy { epoch: 1, version });
    }
    story.breaks("I6", "from policy 5 to 4 in epoch 1");
}

#[test]
fn i6_a_learner_older_than_the_one_before_is_found() {
    let mut story = Story::with_ten_of_each();
    story.note(Author::Worker(0, 0), Entry::Policy { epoch: 2, version: 9 });
    story.note(Author::Worker(0, 1), Entry::Policy { epoch: 1, version: 10 });
    story.breaks("I6", "from epoch 2 to 1");
}

#[test]
fn i9_a_segment_that_nobody_produced_is_found() {
    let mut story = Story::with_ten_of_each();
    story.insert(1, 0, 11..=11);
    let (_, violations) = story.end();
    assert!(violations[0].starts_with("I9: segment 11 of worker 1"), "{violations:#?}");
}

#[test]
fn i9_a_number_that_was_left_out_at_its_source_is_found() {
    let mut story = Story::with_ten_of_each();
    story.produce(0, 0, 12..=12);
    let (_, violations) = story.end();
    assert!(violations[0].starts_with("I9: worker 0, incarnation 0 has produced segment 12"));
}

/// A permanent rejection is counted, but is no loss.
#[test]
fn i9_a_refused_segment_is_counted_and_not_lost() {
    let mut story = Story::with_ten_of_each();
    story.produce(0, 0, 11..=12);
    story.says(Entry::Refused(piece(0, (0, 11)), false));
    story.insert(0, 0, 12..=12);
    story.acknowledge(0, (0, 12));
    let (sums, violations) = story.end();
    assert_eq!((sums.rejected, sums.inserted, sums.lost), (1, 21, 0), "{violations:?}");
    assert_eq!(violations, Vec::<String>::new());
}
