//! One turn of the learner's loop: take a segment or update, publish, and report which evaluations,
//! metrics and checkpoints are due.
//!
//! A turn never waits. The learner process sleeps after an idle turn; the one-process run lets the
//! worker act instead.

use dmprl_shared::segment::{Rejection, Segment};
use dmprl_shared::transport::{ParameterPublisher, SegmentReceiver, TransportError};
use thiserror::Error;

use crate::learner::{Learner, LearnerError};

/// The result of a turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// The learner took a segment or did an update.
    Worked,
    /// There was nothing to do until more segments arrive.
    Idle,
    /// The run has all its environment steps and has done all updates.
    Finished,
}

/// An event that the caller must handle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due {
    /// A line of `metrics.jsonl` is due.
    Metrics,
    /// An evaluation of the newly published policy is due.
    Evaluation,
    /// A checkpoint is due.
    Checkpoint,
    /// The first segment was rejected for this reason.
    Rejection(Rejection),
    /// This many segments are lost.
    Lost(u64),
}

/// The error of a handler.
pub type DueError = Box<dyn std::error::Error + Send + Sync>;

/// Handles an event.
pub type DueHandler<'a> = &'a mut dyn FnMut(Due, &mut Learner) -> Result<(), DueError>;

/// Why the session ended early.
#[derive(Debug, Error)]
pub enum SessionError {
    /// The learner failed.
    #[error(transparent)]
    Learner(#[from] LearnerError),
    /// The transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The handler failed.
    #[error(transparent)]
    Due(DueError),
}

/// A learner with its ends of the transport.
#[derive(Debug)]
pub struct Session<R, P> {
    /// The learner.
    pub learner: Learner,
    receiver: R,
    publisher: P,
    segment: Segment,
    updates_published: u64,
    warm_up_published: bool,
    /// Whether a checkpoint was requested recently because the segment log is full.
    checkpoint_requested: bool,
}

impl<R: SegmentReceiver, P: ParameterPublisher> Session<R, P> {
    /// Starts a session by publishing the first snapshot.
    ///
    /// # Errors
    /// If publishing fails.
    pub fn start(learner: Learner, receiver: R, publisher: P) -> Result<Self, SessionError> {
        let segment = Segment::zeroed(learner.policy().layout());
        let mut session = Self {
            updates_published: learner.counters.updates,
            warm_up_published: false,
            checkpoint_requested: false,
            learner,
            receiver,
            publisher,
            segment,
        };
        session.publish()?;
        Ok(session)
    }

    /// Publishes the current policy.
    ///
    /// # Errors
    /// If publishing fails.
    pub fn publish(&mut self) -> Result<(), SessionError> {
        self.publisher.publish(self.learner.next_snapshot()?)?;
        self.updates_published = self.learner.counters.updates;
        let warm_up = self.learner.config().exploration.warm_up_steps;
        self.warm_up_published = self.learner.counters.env_steps >= warm_up;
        Ok(())
    }

    /// Frees the resources of dead workers. Call it a few times a second.
    ///
    /// # Errors
    /// If the transport fails.
    pub fn maintain(&mut self) -> Result<(), TransportError> {
        self.checkpoint_requested = false;
        self.receiver.maintain()?;
        self.publisher.maintain()
    }

    /// Takes at most one segment or does at most one update. If the segment log is full, a
    /// checkpoint is due; until it is written, no segment is taken and workers wait.
    ///
    /// # Errors
    /// If the learner, the transport or `due` fails.
    pub fn turn(&mut self, due: DueHandler<'_>) -> Result<Turn, SessionError> {
        if self.learner.inbox.is_full() && !self.checkpoint_requested {
            self.checkpoint_requested = true;
            due(Due::Checkpoint, &mut self.learner).map_err(SessionError::Due)?;
        }
        if self.learner.may_take() && self.receiver.try_receive(&mut self.segment)? {
            self.take(due)?;
            return Ok(Turn::Worked);
        }
        if self.learner.update_due() {
            self.learner.update()?;
            if self.learner.publish_due(self.learner.counters.updates - self.updates_published) {
                self.publish()?;
            }
            return Ok(Turn::Worked);
        }
        Ok(if self.learner.has_all_steps() { Turn::Finished } else { Turn::Idle })
    }

    /// Takes at most `segments_max` queued segments without updating.
    ///
    /// # Errors
    /// If the learner, the transport or `due` fails.
    pub fn drain(&mut self, due: DueHandler<'_>, segments_max: usize) -> Result<(), SessionError> {
        for _ in 0..segments_max {
            if self.learner.has_all_steps() || !self.receiver.try_receive(&mut self.segment)? {
                break;
            }
            self.take(due)?;
        }
        Ok(())
    }

    fn take(&mut self, due: DueHandler<'_>) -> Result<(), SessionError> {
        let before = self.learner.counters.env_steps;
        let lost_before = self.learner.counters.lost;
        let inserted = self.learner.insert(&self.segment);
        let lost = self.learner.counters.lost - lost_before;
        if lost > 0 {
            due(Due::Lost(lost), &mut self.learner).map_err(SessionError::Due)?;
        }
        if let Err(why) = inserted {
            // Only the first rejection of each kind is reported. Duplicates are no fault.
            if why != Rejection::Duplicate && self.learner.counters.rejected.of(why) == 1 {
                due(Due::Rejection(why), &mut self.learner).map_err(SessionError::Due)?;
            }
            return Ok(());
        }
        let after = self.learner.counters.env_steps;
        let config = self.learner.config();
        if !self.warm_up_published && after >= config.exploration.warm_up_steps {
            self.publish()?;
        }
        let config = self.learner.config();
        // At the end of the run, these follow the last update instead.
        let crossed =
            |every: u64| before / every != after / every && after < self.learner.config().run.steps;
        let due_now = [
            (Due::Metrics, crossed(config.metrics.interval_steps)),
            (Due::Evaluation, crossed(config.evaluation.interval_steps)),
            (Due::Checkpoint, crossed(config.checkpoint.interval_steps)),
        ];
        for (what, _) in due_now.into_iter().filter(|(_, crossed)| *crossed) {
            if what == Due::Evaluation {
                self.publish()?;
            }
            due(what, &mut self.learner).map_err(SessionError::Due)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use dmprl_shared::config::Layers;
    use dmprl_shared::parameters::ParameterSnapshot;
    use dmprl_shared::segment::{
        HINDSIGHT, LAYOUT_VERSION, SegmentHeader, TRUNCATED, block_checksum,
    };
    use dmprl_shared::transport::{ParameterSubscriber, SegmentSender, SendOutcome, in_process};

    use super::*;
    use crate::learner::Counters;
    use crate::learner::tests::spec;

    const CAPACITY: usize = 4;

    struct Run {
        session: Session<in_process::Receiver, in_process::Publisher>,
        sender: in_process::Sender,
        subscriber: in_process::Subscriber,
        segment: Segment,
        due: Vec<(Due, u64)>,
    }

    fn run(keys: &[(&str, &str)]) -> Run {
        let mut layers = Layers::new();
        let common = [
            ("policy.hidden", "[8]"),
            ("algorithm.critic_hidden", "[8]"),
            ("algorithm.batch_size", "8"),
            ("exploration.warm_up_steps", "20"),
            ("actors.workers", "1"),
            ("run.steps", "100"),
            ("metrics.interval_steps", "25"),
            ("evaluation.interval_steps", "40"),
            ("checkpoint.interval_steps", "50"),
        ];
        for (key, value) in common.iter().chain(keys) {
            layers.set("test", key, value).unwrap();
        }
        let learner = Learner::new(layers.finish().unwrap(), &spec(), 1).unwrap();
        let layout = learner.policy().layout();
        let hash = learner.policy().architecture_hash();
        let mut segment = Segment::zeroed(layout);
        segment.header = SegmentHeader {
            layout_version: LAYOUT_VERSION,
            flags: TRUNCATED,
            run_id: 1,
            architecture_hash: hash,
            steps_len: 5,
            segment_steps: 5,
            observation_len: layout.observation_len as u32,
            action_len: layout.action_len as u32,
            checksum: block_checksum(&segment.block),
            ..SegmentHeader::default()
        };
        let (mut senders, receiver) = in_process::segment_queues(1, CAPACITY, layout);
        let (publisher, subscriber) = in_process::parameter_channel(hash);
        let session = Session::start(learner, receiver, publisher).unwrap();
        Run { session, sender: senders.remove(0), subscriber, segment, due: Vec::new() }
    }

    impl Run {
        fn send(&mut self) -> SendOutcome {
            self.segment.header.sequence += 1;
            self.segment.header.episode += 1;
            self.sender.try_send(&self.segment.header, &self.segment.block).unwrap()
        }

        fn turn(&mut self) -> Turn {
            let due = &mut self.due;
            self.session
                .turn(&mut |what, learner: &mut Learner| {
                    due.push((what, learner.counters.env_steps));
                    Ok(())
                })
                .unwrap()
        }

        fn turns(&mut self) -> Turn {
            loop {
                match self.turn() {
                    Turn::Worked => {}
                    end => return end,
                }
            }
        }
    }

    #[test]
    fn what_is_due_falls_due_at_its_step_and_the_run_ends_with_its_updates() {
        let mut run = run(&[]);
        let mut end = Turn::Idle;
        for _ in 0..20 {
            assert_eq!(end, Turn::Idle);
            assert_eq!(run.send(), SendOutcome::Delivered);
            end = run.turns();
        }
        assert_eq!(end, Turn::Finished);
        let expected = [
            (Due::Metrics, 25),
            (Due::Evaluation, 40),
            (Due::Metrics, 50),
            (Due::Checkpoint, 50),
            (Due::Metrics, 75),
            (Due::Evaluation, 80),
        ];
        assert_eq!(run.due, expected);
        // 2 updates for each of the 16 segments after the warm-up.
        assert_eq!(run.session.learner.counters.updates, 32);
        assert_eq!(run.session.learner.samples_per_insert(), 32.0 * 8.0 / 100.0);
    }

    #[test]
    fn a_learner_behind_on_its_updates_leaves_segments_in_the_queue() {
        let mut run =
            run(&[("pacing.tolerance_segments", "1"), ("exploration.warm_up_steps", "0")]);
        (0..CAPACITY).for_each(|_| assert_eq!(run.send(), SendOutcome::Delivered));
        assert_eq!(run.send(), SendOutcome::Full);
        assert_eq!(run.turn(), Turn::Worked);
        let taken = |run: &Run| run.session.learner.counters.segments;
        assert_eq!((taken(&run), run.session.learner.counters.updates), (1, 0));
        // Two updates are owed for the first segment; one of them makes room for the next.
        assert_eq!(run.turn(), Turn::Worked);
        assert_eq!((taken(&run), run.session.learner.counters.updates), (1, 1));
        assert_eq!(run.turn(), Turn::Worked);
        assert_eq!((taken(&run), run.session.learner.counters.updates), (2, 1));
    }

    #[test]
    fn the_end_of_the_warm_up_is_published_at_once() {
        let mut run = run(&[]);
        let mut snapshot = ParameterSnapshot::default();
        assert!(run.subscriber.newest(&mut snapshot).unwrap());
        assert_eq!((snapshot.version, snapshot.env_steps), (1, 0));
        for _ in 0..4 {
            run.send();
            run.turns();
        }
        assert!(run.subscriber.newest(&mut snapshot).unwrap());
        assert_eq!((snapshot.version, snapshot.env_steps), (2, 20));
    }

    #[test]
    fn a_rollout_is_learned_from_and_published_at_once_and_what_was_in_flight_is_stale() {
        let mut run = run(&[
            ("algorithm.name", "ndp"),
            ("exploration.warm_up_steps", "0"),
            ("algorithm.ndp.rollout_segments", "3"),
            ("algorithm.ndp.minibatches", "2"),
            ("algorithm.ndp.epochs", "2"),
        ]);
        let mut snapshot = ParameterSnapshot::default();
        run.segment.header.policy_version = 1;
        (0..CAPACITY).for_each(|_| assert_eq!(run.send(), SendOutcome::Delivered));
        assert_eq!(run.turns(), Turn::Idle);
        // Two epochs of two minibatches of the first three segments; the fourth came too late.
        let counters = run.session.learner.counters;
        assert_eq!((counters.segments, counters.stale_segments), (4, 1));
        assert_eq!((counters.env_steps, counters.updates), (20, 4));
        assert!(run.subscriber.newest(&mut snapshot).unwrap());
        assert_eq!((snapshot.version, snapshot.env_steps), (2, 15));
        run.segment.header.policy_version = 2;
        (0..3).for_each(|_| assert_eq!(run.send(), SendOutcome::Delivered));
        assert_eq!(run.turns(), Turn::Idle);
        assert!(run.subscriber.newest(&mut snapshot).unwrap());
        assert_eq!(snapshot.version, 3);
        let line = run.session.learner.metrics_line();
        assert_eq!((line.stale_segments, line.updates, line.replay_segments), (1, 8, 0));
        assert!(line.policy_loss.is_some() && line.critic_loss.is_none());
    }

    #[test]
    fn a_refused_segment_is_counted_and_nothing_else() {
        let mut run = run(&[]);
        run.segment.header.run_id = 2;
        run.send();
        assert_eq!(run.turns(), Turn::Idle);
        assert_eq!(run.due, [(Due::Rejection(Rejection::Run), 0)]);
        run.send();
        assert_eq!(run.turns(), Turn::Idle);
        assert_eq!(run.due.len(), 1, "the second of a kind is only counted");
        let counters = run.session.learner.counters;
        assert_eq!(
            (counters.env_steps, counters.rejected.run, counters.rejected.total()),
            (0, 2, 2)
        );
    }

    #[test]
    fn a_duplicate_is_refused_and_a_gap_is_counted_as_lost() {
        let mut run = run(&[]);
        run.send();
        run.segment.header.sequence -= 1;
        run.send();
        run.segment.header.sequence += 3;
        run.send();
        run.segment.header.incarnation = 1;
        run.segment.header.sequence = 0;
        run.send();
        assert_eq!(run.turns(), Turn::Idle);
        let counters = run.session.learner.counters;
        assert_eq!((counters.segments, counters.rejected.duplicate, counters.lost), (3, 1, 3));
    }

    #[test]
    fn copies_with_other_goals_are_experience_and_nothing_else() {
        let mut run = run(&[("exploration.warm_up_steps", "0")]);
        run.send();
        run.turns();
        let real = run.session.learner.counters;
        assert_eq!((real.env_steps, real.updates), (5, 2));
        run.segment.header.flags = HINDSIGHT;
        (0..3).for_each(|_| assert_eq!(run.send(), SendOutcome::Delivered));
        run.turns();
        let counters = run.session.learner.counters;
        assert_eq!((counters.hindsight_segments, run.session.learner.replay.len()), (3, 4));
        assert_eq!(counters, Counters { hindsight_segments: 3, received: 4, ..real });
        let line = run.session.learner.metrics_line();
        assert_eq!((line.episodes, line.hindsight_segments, line.lost), (1, 3, 0));
        assert_eq!(line.updates_owed, 0.0);
        // Their sequence numbers count: a used one is rejected, a missing one is lost.
        run.segment.header.sequence -= 1;
        run.send();
        run.segment.header.sequence += 1;
        run.send();
        run.turns();
        let counters = run.session.learner.counters;
        let refused = counters.rejected.duplicate;
        assert_eq!((counters.hindsight_segments, refused, counters.lost), (4, 1, 1));
    }

    #[test]
    fn a_stop_takes_what_is_queued_and_updates_nothing() {
        let mut run = run(&[("exploration.warm_up_steps", "0")]);
        (0..3).for_each(|_| assert_eq!(run.send(), SendOutcome::Delivered));
        run.session.drain(&mut |_, _: &mut Learner| Ok(()), 2).unwrap();
        let counters = run.session.learner.counters;
        assert_eq!((counters.segments, counters.updates), (2, 0));
    }
}
