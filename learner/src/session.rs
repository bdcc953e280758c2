//! The learner's loop, one turn at a time: take segments, update, publish, and at their steps ask
//! for evaluations, write metrics and checkpoints.
//!
//! A turn never waits, so the same loop serves the learner process (which sleeps when a turn was
//! idle) and the one-process run (which lets the worker act instead).

use dmprl_shared::segment::Segment;
use dmprl_shared::transport::{ParameterPublisher, SegmentReceiver, TransportError};
use thiserror::Error;

use crate::learner::{Learner, LearnerError};

/// What a turn did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// Something.
    Worked,
    /// Nothing: it waits for segments.
    Idle,
    /// The run has all its steps and all the updates owed for them.
    Finished,
}

/// What falls due as environment steps come in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due {
    /// A line of `metrics.jsonl`.
    Metrics,
    /// An evaluation of the policy that has just been published.
    Evaluation,
    /// A checkpoint.
    Checkpoint,
}

/// Why the session ended early.
#[derive(Debug, Error)]
pub enum SessionError<E> {
    /// The learner failed.
    #[error(transparent)]
    Learner(#[from] LearnerError),
    /// The transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// What was due could not be done.
    #[error(transparent)]
    Due(E),
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
}

impl<R: SegmentReceiver, P: ParameterPublisher> Session<R, P> {
    /// Publishes the first snapshot.
    ///
    /// # Errors
    /// If publishing fails.
    pub fn start<E>(learner: Learner, receiver: R, publisher: P) -> Result<Self, SessionError<E>> {
        let segment = Segment::zeroed(learner.policy().layout());
        let mut session = Self {
            updates_published: learner.counters.updates,
            warm_up_published: false,
            learner,
            receiver,
            publisher,
            segment,
        };
        session.publish()?;
        Ok(session)
    }

    /// Publishes the actor as it is.
    ///
    /// # Errors
    /// If publishing fails.
    pub fn publish<E>(&mut self) -> Result<(), SessionError<E>> {
        self.publisher.publish(self.learner.next_snapshot()?)?;
        self.updates_published = self.learner.counters.updates;
        let warm_up = self.learner.config().exploration.warm_up_steps;
        self.warm_up_published = self.learner.counters.env_steps >= warm_up;
        Ok(())
    }

    /// Frees what dead workers left; to be called a few times a second.
    ///
    /// # Errors
    /// If the transport fails.
    pub fn maintain(&mut self) -> Result<(), TransportError> {
        self.receiver.maintain()
    }

    /// Takes at most one segment, or does at most one update.
    ///
    /// # Errors
    /// If learner or transport fail, or `due` does.
    pub fn turn<E>(
        &mut self,
        due: &mut dyn FnMut(Due, &mut Learner) -> Result<(), E>,
    ) -> Result<Turn, SessionError<E>> {
        if self.learner.may_take() && self.receiver.try_receive(&mut self.segment)? {
            self.take(due)?;
            return Ok(Turn::Worked);
        }
        if self.learner.pacing.update_due() {
            self.learner.update()?;
            let every = self.learner.config().learner.publish_every_updates;
            if self.learner.counters.updates - self.updates_published >= every {
                self.publish()?;
            }
            return Ok(Turn::Worked);
        }
        Ok(if self.learner.has_all_steps() { Turn::Finished } else { Turn::Idle })
    }

    fn take<E>(
        &mut self,
        due: &mut dyn FnMut(Due, &mut Learner) -> Result<(), E>,
    ) -> Result<(), SessionError<E>> {
        let before = self.learner.counters.env_steps;
        // A refused segment is counted by reason; the metrics show it.
        if self.learner.insert(&self.segment).is_err() {
            return Ok(());
        }
        let after = self.learner.counters.env_steps;
        let config = self.learner.config();
        if !self.warm_up_published && after >= config.exploration.warm_up_steps {
            self.publish()?;
        }
        let config = self.learner.config();
        // The last evaluation, metrics line and checkpoint follow the last update.
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
