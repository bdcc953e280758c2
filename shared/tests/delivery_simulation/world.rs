//! A simulated world: two workers, their links, and one learner with its checkpoint and log.

use std::path::{Path, PathBuf};

use dmprl_shared::config::DeliveryLevel;
use dmprl_shared::seeds;
use dmprl_shared::segment::{Rejection, Segment, SegmentHeader, SegmentLayout};
use dmprl_shared::transport::delivery::{
    Acknowledgements, Inbox, LogIdentity, Outbox, SegmentLog, Watermark,
};
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::link::Link;

const WORKERS: usize = 2;
const STEPS: u32 = 250;
/// Number of rounds without faults, within which every kept segment must arrive.
const FAULTLESS_ROUNDS: u32 = 100;
/// Number of these rounds in which workers still produce segments.
const PRODUCING_ROUNDS: u32 = 3;
/// Maximum size of the log, small enough that the log sometimes fills up.
const LOG_BYTES_MAX: u64 = 5_000;
pub const LAYOUT: SegmentLayout =
    SegmentLayout { segment_steps: 1, observation_len: 1, action_len: 1 };

/// Counts of all events, in one or several simulations.
#[derive(Debug, Default)]
pub struct Tally {
    pub inserted: u64,
    pub duplicates: u64,
    pub lost_at_level_memory: u64,
    pub resent: u64,
    pub drops: u64,
    pub repetitions: u64,
    pub renewals: u64,
    pub learner_deaths: u64,
    pub worker_deaths: u64,
    pub torn_logs: u64,
    pub full_logs: u64,
    pub stale_acknowledgements: u64,
    pub full_outboxes: u64,
}

impl Tally {
    fn counts(&self) -> [u64; 13] {
        [
            self.inserted,
            self.duplicates,
            self.lost_at_level_memory,
            self.resent,
            self.drops,
            self.repetitions,
            self.renewals,
            self.learner_deaths,
            self.worker_deaths,
            self.torn_logs,
            self.full_logs,
            self.stale_acknowledgements,
            self.full_outboxes,
        ]
    }

    pub fn add(&mut self, more: &Self) {
        let more = more.counts();
        let ours = [
            &mut self.inserted,
            &mut self.duplicates,
            &mut self.lost_at_level_memory,
            &mut self.resent,
            &mut self.drops,
            &mut self.repetitions,
            &mut self.renewals,
            &mut self.learner_deaths,
            &mut self.worker_deaths,
            &mut self.torn_logs,
            &mut self.full_logs,
            &mut self.stale_acknowledgements,
            &mut self.full_outboxes,
        ];
        ours.into_iter().zip(more).for_each(|(ours, more)| *ours += more);
    }

    /// Whether every event has occurred at least once.
    pub fn has_every_event(&self) -> bool {
        self.counts().iter().all(|&count| count > 0)
    }
}

struct Worker {
    outbox: Outbox,
    incarnation: u32,
    /// The next sequence number.
    sequence: u64,
    link: Link,
    /// Epoch of the newest learner whose acknowledgement the worker has read.
    heard: u64,
}

/// State that survives the death of a learner. Both fields have one entry per worker.
struct Checkpoint {
    marks: Vec<Watermark>,
    /// Number of inserted segments.
    inserted: [usize; WORKERS],
}

pub struct World {
    random: Xoshiro256PlusPlus,
    level: DeliveryLevel,
    log_path: PathBuf,
    outbox_segments: usize,
    workers: Vec<Worker>,
    /// `None` while no learner is alive.
    inbox: Option<Inbox>,
    epoch: u64,
    /// The learner's replay: the inserted segments of each worker, in order.
    inserted: [Vec<Watermark>; WORKERS],
    /// Segments inserted by learners that died before a checkpoint contained them.
    forgotten: [Vec<Watermark>; WORKERS],
    /// The last acknowledged segment of each incarnation of each worker.
    acked: [Vec<Watermark>; WORKERS],
    checkpoint: Checkpoint,
    /// A checkpoint that is being written, and the size of the log at its start.
    saving: Option<(Checkpoint, u64)>,
    /// All published acknowledgements, because old ones may arrive late.
    published: Vec<Acknowledgements>,
    tally: Tally,
}

fn value(mark: Watermark, worker: usize) -> f32 {
    (mark.sequence * 10 + u64::from(mark.incarnation) * 1_000 + worker as u64) as f32
}

impl World {
    pub fn new(seed: u64, log_path: &Path) -> Self {
        let mut random = seeds::stream(seed, "delivery", 0);
        let level = if seed.is_multiple_of(2) { DeliveryLevel::Memory } else { DeliveryLevel::Log };
        let (outbox_segments, queue) = (random.random_range(1..=8), random.random_range(1..=4));
        let worker = |index| Worker {
            outbox: Outbox::new(LAYOUT, outbox_segments, index, 0),
            incarnation: 0,
            sequence: 1,
            link: Link::new(seeds::stream(seed, "link", index.into()), queue),
            heard: 0,
        };
        let _ = std::fs::remove_file(log_path);
        let mut world = Self {
            workers: (0..WORKERS as u32).map(worker).collect(),
            random,
            level,
            log_path: log_path.to_owned(),
            outbox_segments,
            inbox: None,
            epoch: 0,
            inserted: Default::default(),
            forgotten: Default::default(),
            acked: std::array::from_fn(|_| vec![Watermark::default()]),
            checkpoint: Checkpoint { marks: Vec::new(), inserted: [0; WORKERS] },
            saving: None,
            published: Vec::new(),
            tally: Tally::default(),
        };
        world.start_learner();
        world
    }

    fn chance(&mut self, one_in: u32) -> bool {
        self.random.random_range(0..one_in) == 0
    }

    /// Runs random events with faults.
    pub fn run_with_faults(&mut self) {
        for _ in 0..STEPS {
            match self.random.random_range(0..100) {
                0..40 => {
                    let worker = self.random.random_range(0..WORKERS);
                    self.work(worker);
                }
                40..80 => self.take(),
                80..90 => self.acknowledge(),
                90..93 => self.save(),
                93..96 => self.kill_learner(),
                96..97 => {
                    let worker = self.random.random_range(0..WORKERS);
                    self.kill_worker(worker);
                }
                _ => self.start_learner(),
            }
        }
    }

    /// Runs without faults and checks that all kept and newly produced segments arrive.
    pub fn run_without_faults(&mut self) {
        self.workers.iter_mut().for_each(|worker| worker.link.faults = false);
        self.start_learner();
        for round in 0..FAULTLESS_ROUNDS {
            let all_arrived = self.workers.iter().all(|worker| worker.outbox.is_empty());
            if round > PRODUCING_ROUNDS && all_arrived {
                break;
            }
            for index in 0..WORKERS {
                self.hear(index, self.published.len().checked_sub(1));
                if round < PRODUCING_ROUNDS {
                    self.produce(index);
                }
                let worker = &mut self.workers[index];
                worker.outbox.offer(&mut worker.link).unwrap();
            }
            (0..WORKERS).for_each(|_| self.take());
            self.acknowledge();
            if self.log_is_full() {
                self.save();
            }
        }
        for (index, worker) in self.workers.iter().enumerate() {
            let outbox = &worker.outbox;
            assert!(outbox.is_empty(), "worker {index} still keeps {}", outbox.len());
            assert_eq!(outbox.sent().acked, outbox.sent().produced, "worker {index}");
            let last = Watermark { incarnation: worker.incarnation, sequence: worker.sequence - 1 };
            assert!(last.sequence > 0, "worker {index} has produced no segment");
            assert_eq!(self.inserted[index].last(), Some(&last), "worker {index}");
        }
    }

    pub fn tally(mut self) -> Tally {
        for worker in &self.workers {
            self.tally.resent += worker.outbox.sent().resent;
            self.tally.drops += worker.link.drops;
            self.tally.repetitions += worker.link.repetitions;
            self.tally.renewals += worker.link.renewals;
        }
        self.tally.inserted += self.inserted.iter().map(|all| all.len() as u64).sum::<u64>();
        self.tally
    }

    /// One step of a worker: it may read an acknowledgement, produces a segment if there is room,
    /// and offers its segments.
    fn work(&mut self, index: usize) {
        if !self.published.is_empty() && self.chance(2) {
            let newest = self.published.len() - 1;
            let late = if self.chance(4) { self.random.random_range(0..=newest) } else { newest };
            self.hear(index, Some(late));
        }
        self.produce(index);
        let worker = &mut self.workers[index];
        worker.outbox.offer(&mut worker.link).unwrap();
        let sent = worker.outbox.sent();
        assert!(sent.sent - sent.resent <= sent.produced && sent.acked <= sent.produced);
    }

    fn produce(&mut self, index: usize) {
        let worker = &mut self.workers[index];
        let mark = Watermark { incarnation: worker.incarnation, sequence: worker.sequence };
        let header = SegmentHeader {
            worker_id: index as u32,
            incarnation: mark.incarnation,
            sequence: mark.sequence,
            ..SegmentHeader::default()
        };
        let block = vec![value(mark, index); LAYOUT.block_len()];
        if worker.outbox.put(&header, &block) {
            worker.sequence += 1;
        } else {
            self.tally.full_outboxes += 1;
        }
    }

    /// A worker reads an acknowledgement. Checks that the segments that it then discards have been
    /// stored as the delivery level guarantees.
    fn hear(&mut self, index: usize, which: Option<usize>) {
        let Some(acknowledgements) = which.map(|which| &self.published[which]) else { return };
        self.tally.stale_acknowledgements += u64::from(acknowledgements.epoch < self.epoch);
        let worker = &mut self.workers[index];
        let kept_before = worker.outbox.len();
        worker.outbox.acknowledge(acknowledgements);
        let gone = (kept_before - worker.outbox.len()) as u64;
        let is_stale = acknowledgements.epoch < worker.heard;
        assert!(gone == 0 || !is_stale, "an acknowledgement of a replaced learner was used");
        worker.heard = worker.heard.max(acknowledgements.epoch);
        if let Some(last) = self.acked[index].last_mut() {
            last.sequence += gone;
        }
        if gone > 0 && self.level == DeliveryLevel::Memory {
            let mark = self.acked[index][self.acked[index].len() - 1];
            let known = [&self.inserted[index], &self.forgotten[index]];
            assert!(known.iter().any(|all| all.contains(&mark)), "{mark:?} was never inserted");
        }
        self.assert_acked_is_inserted();
    }

    /// Checks, at level `log` and while a learner is alive, that every segment that a worker has
    /// discarded is in the replay.
    fn assert_acked_is_inserted(&self) {
        if self.level == DeliveryLevel::Memory || self.inbox.is_none() {
            return;
        }
        for (index, acked) in self.acked.iter().enumerate() {
            for mark in acked.iter().filter(|mark| mark.sequence > 0) {
                let is_inserted = self.inserted[index].binary_search(mark).is_ok();
                assert!(is_inserted, "worker {index}: {mark:?} was acknowledged and is lost");
            }
        }
    }

    fn log_is_full(&self) -> bool {
        self.inbox.as_ref().is_some_and(Inbox::is_full)
    }

    /// The learner receives a segment from one of the queues and inserts it, like
    /// `Learner::insert`.
    fn take(&mut self) {
        let Some(inbox) = &mut self.inbox else { return };
        if !inbox.has_room() {
            self.tally.full_logs += 1;
            return;
        }
        let first = self.random.random_range(0..WORKERS);
        let taken = (0..WORKERS)
            .find_map(|turn| self.workers[(first + turn) % WORKERS].link.queue.pop_front());
        let Some(segment) = taken else { return };
        match inbox.settle(&segment.header, &segment.block) {
            Ok(lost) => self.insert(&segment, lost),
            Err(Rejection::Duplicate) => self.tally.duplicates += 1,
            Err(why) => panic!("{why}"),
        }
    }

    fn insert(&mut self, segment: &Segment, lost: u64) {
        let header = &segment.header;
        let index = header.worker_id as usize;
        let mark = Watermark { incarnation: header.incarnation, sequence: header.sequence };
        assert_eq!(segment.block, vec![value(mark, index); LAYOUT.block_len()], "{mark:?}");
        let last = self.inserted[index].last().copied().unwrap_or_default();
        assert!(mark > last, "worker {index}: {mark:?} after {last:?}");
        for sequence in mark.sequence - lost..mark.sequence {
            // Only the death of a learner may lose a segment, and only at level `memory`.
            let missing = Watermark { sequence, ..mark };
            assert_eq!(self.level, DeliveryLevel::Memory, "worker {index}: {missing:?} is lost");
            assert!(self.forgotten[index].contains(&missing), "{missing:?} was never inserted");
            self.tally.lost_at_level_memory += 1;
        }
        let gap = if mark.incarnation == last.incarnation { last.sequence } else { 0 };
        assert_eq!(mark.sequence - gap - 1, lost, "worker {index}: an uncounted gap");
        self.inserted[index].push(mark);
    }

    /// Acknowledges like the learner's loop. The learner may die before it publishes, and leave a
    /// torn log record, which was never acknowledged.
    fn acknowledge(&mut self) {
        let dies = self.workers[0].link.faults && self.chance(20);
        let Some(inbox) = &mut self.inbox else { return };
        let len = || std::fs::metadata(&self.log_path).map_or(0, |metadata| metadata.len());
        let before = if dies { len() } else { 0 };
        let marks = inbox.acknowledge().unwrap().to_vec();
        if !dies {
            self.published.push(Acknowledgements { epoch: self.epoch, marks });
            return;
        }
        let after = len();
        if after > before {
            let left = self.random.random_range(before..after);
            let file = std::fs::File::options().write(true).open(&self.log_path).unwrap();
            file.set_len(left).unwrap();
            self.tally.torn_logs += 1;
        }
        self.kill_learner();
    }

    /// Starts a checkpoint, or completes the current one. Segments arrive while it is written. The
    /// learner may die before it truncates the log.
    fn save(&mut self) {
        let dies = self.workers[0].link.faults && self.chance(10);
        let Some(inbox) = &mut self.inbox else { return };
        let Some((checkpoint, logged)) = self.saving.take() else {
            let inserted = self.inserted.each_ref().map(Vec::len);
            let checkpoint = Checkpoint { marks: inbox.settled().to_vec(), inserted };
            self.saving = Some((checkpoint, inbox.logged()));
            return;
        };
        self.checkpoint = checkpoint;
        if dies {
            self.kill_learner();
            return;
        }
        inbox.checkpointed(logged).unwrap();
    }

    fn kill_learner(&mut self) {
        if self.inbox.take().is_none() {
            return;
        }
        self.tally.learner_deaths += 1;
        self.saving = None;
        for (index, kept) in self.checkpoint.inserted.iter().enumerate() {
            self.forgotten[index].extend(self.inserted[index].drain(kept..));
        }
    }

    /// Starts a learner from checkpoint and log, with empty queues.
    fn start_learner(&mut self) {
        if self.inbox.is_some() {
            return;
        }
        self.epoch += 1;
        let mut inbox = Inbox::new(WORKERS);
        inbox.restore(&self.checkpoint.marks);
        if self.level == DeliveryLevel::Log {
            let identity = LogIdentity { run_id: 1, architecture_hash: 1 };
            let log = SegmentLog::open(&self.log_path, identity, LAYOUT, LOG_BYTES_MAX);
            let mut log = log.unwrap();
            // Like `Learner::recover`.
            log.replay(|segment| {
                if !inbox.has(&segment.header) {
                    let lost = inbox.settle(&segment.header, &segment.block).unwrap();
                    self.insert(segment, lost);
                }
            })
            .unwrap();
            inbox.log_to(log);
        }
        self.inbox = Some(inbox);
        self.workers.iter_mut().for_each(|worker| worker.link.new_learner(self.epoch));
        self.assert_acked_is_inserted();
    }

    /// Kills a worker, which loses all segments in its outbox, and possibly its queue.
    fn kill_worker(&mut self, index: usize) {
        let with_queue = self.chance(2);
        let worker = &mut self.workers[index];
        self.tally.worker_deaths += 1;
        self.tally.resent += worker.outbox.sent().resent;
        worker.incarnation += 1;
        worker.sequence = 1;
        let (id, incarnation) = (index as u32, worker.incarnation);
        worker.outbox = Outbox::new(LAYOUT, self.outbox_segments, id, incarnation);
        worker.heard = 0;
        if with_queue {
            worker.link.queue.clear();
        }
        self.acked[index].push(Watermark { incarnation, sequence: 0 });
    }
}
