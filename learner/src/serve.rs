//! Stages 5 to 7 of 8 as a process: serves the run's workers from the first policy to the last
//! checkpoint.
//!
//! [`Server::run`] is the learner's loop. It takes turns of a [`Session`], acknowledges segments
//! and writes records with a [`Recorder`], until the run is complete or a stop is requested. The
//! program around it parses the arguments and makes the learner ([`crate::start`]) and its ends of
//! the transport. The one-process run has its own schedule, but shares
//! [`request_missed_evaluation`] and [`close`].

use std::time::{Duration, Instant};

use dmprl_shared::supervision::{Report, ReportError, Supervisor};
use dmprl_shared::transport::{
    AcknowledgementPublisher, ParameterPublisher, SegmentReceiver, TransportError,
};
use thiserror::Error;

use crate::learner::Learner;
use crate::recorder::{Evaluate, Recorder};
use crate::session::{Due, DueError, Session, SessionError, Turn};

/// Pause after an idle turn; short compared to a worker's segment of about 1 ms.
const IDLE_PAUSE: Duration = Duration::from_micros(100);
/// Interval between two clean-ups of resources of dead workers.
const MAINTENANCE_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum interval between two acknowledgements.
const ACKNOWLEDGEMENT_INTERVAL: Duration = Duration::from_millis(10);
/// Environment steps after which the first segment is reported, to measure the start-up time.
const FIRST_STEPS: u64 = 1;

/// Why a learner stopped early.
#[derive(Debug, Error)]
pub enum ServeError {
    /// The learner or its transport failed.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The acknowledgement channel failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A record could not be written.
    #[error(transparent)]
    Due(#[from] DueError),
    /// A report could not be sent.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// The supervisor is gone.
    #[error("the supervisor is gone; the learner wrote a checkpoint and stopped")]
    SupervisorGone,
}

/// A learner that serves workers.
pub struct Server<'a, R, P, A> {
    /// The learner and its ends of the transport.
    pub session: Session<R, P>,
    /// The learner's end of the acknowledgement channel.
    pub acknowledgements: A,
    /// Segments that the queues of all workers can hold.
    pub queued_segments_max: usize,
    /// Writes the records.
    pub recorder: Recorder<'a>,
    /// Requests stop or finish.
    pub supervisor: &'a dyn Supervisor,
}

impl<R, P, A> Server<'_, R, P, A>
where
    R: SegmentReceiver,
    P: ParameterPublisher,
    A: AcknowledgementPublisher,
{
    /// Serves the workers until the run is complete or a stop is requested, then writes a
    /// checkpoint.
    ///
    /// # Errors
    /// If the learner, the transport, a record or a report fails.
    pub fn run(mut self) -> Result<(), ServeError> {
        let supervisor = self.supervisor;
        supervisor.report(&Report::LearnerReady)?;
        // If the supervisor is gone, the loop sees a stop and writes a checkpoint. A failed report
        // must not end the learner before that.
        let mut request = |request| {
            let _ = supervisor.report(&Report::Evaluate(request));
            Ok(())
        };
        request_missed_evaluation(&mut self.session, &mut self.recorder, &mut request)?;
        let is_complete = self.turns(&mut request)?;
        let Self { mut session, mut recorder, queued_segments_max, .. } = self;
        if !is_complete {
            // The checkpoint includes the queued segments. It does not wait for more.
            session.drain(&mut |_, _| Ok(()), queued_segments_max)?;
        }
        let before = session.learner.counters.env_failures;
        let env_failures = || before.max(supervisor.totals().env_failures);
        let ending =
            SessionEnd { is_complete, evaluate: &mut request, env_failures: &env_failures };
        close(&mut session, &mut recorder, supervisor, ending)
    }

    /// Takes turns until the run is complete (true) or a stop is requested (false).
    fn turns(&mut self, request: Evaluate<'_>) -> Result<bool, ServeError> {
        let (mut maintained, mut acknowledged) = (Instant::now(), Instant::now());
        let mut first_steps = self.session.learner.counters.env_steps + FIRST_STEPS;
        loop {
            self.take_totals();
            let Self { session, acknowledgements, recorder, supervisor, .. } = self;
            if supervisor.stop_requested() {
                return Ok(false);
            }
            if supervisor.finish_requested() {
                return Ok(true);
            }
            let mut due = |due: Due, learner: &mut Learner| recorder.due(due, learner, request);
            match session.turn(&mut due)? {
                Turn::Worked => {}
                Turn::Idle => std::thread::sleep(IDLE_PAUSE),
                Turn::Finished => return Ok(true),
            }
            if session.learner.counters.env_steps >= first_steps {
                first_steps = u64::MAX;
                let _ = supervisor.report(&Report::FirstSegment);
            }
            let owed = session.learner.inbox.owes_acknowledgement();
            if owed || acknowledged.elapsed() >= ACKNOWLEDGEMENT_INTERVAL {
                if let Some(marks) = recorder.acknowledge(&mut session.learner) {
                    acknowledgements.acknowledge(marks)?;
                }
                acknowledged = Instant::now();
            }
            if maintained.elapsed() >= MAINTENANCE_INTERVAL {
                session.maintain()?;
                acknowledgements.maintain()?;
                maintained = Instant::now();
            }
            recorder.poll_checkpoint(&mut session.learner);
            recorder.progress(&session.learner);
        }
    }

    /// Copies the supervisor's totals. A checkpoint may have higher ones than the supervisor has
    /// sent so far.
    fn take_totals(&mut self) {
        let (counters, totals) = (&mut self.session.learner.counters, self.supervisor.totals());
        counters.env_failures = counters.env_failures.max(totals.env_failures);
        counters.worker_restarts = counters.worker_restarts.max(totals.workers.restarts);
        if totals.sent.produced >= counters.sent.produced {
            counters.sent = totals.sent;
        }
    }
}

/// Requests the evaluation that is missing because an earlier session was stopped.
///
/// # Errors
/// If publishing or `evaluate` fails.
pub fn request_missed_evaluation<R: SegmentReceiver, P: ParameterPublisher>(
    session: &mut Session<R, P>,
    recorder: &mut Recorder<'_>,
    evaluate: Evaluate<'_>,
) -> Result<(), ServeError> {
    if recorder.is_owed_an_evaluation(&session.learner) {
        session.publish()?;
        recorder.due(Due::Evaluation, &mut session.learner, evaluate)?;
    }
    Ok(())
}

/// How a session ends.
pub struct SessionEnd<'a> {
    /// Whether the run is complete, or was stopped.
    pub is_complete: bool,
    /// Requests the evaluation of a saved policy.
    pub evaluate: Evaluate<'a>,
    /// Returns the failures of environments so far. The last evaluation may add some.
    pub env_failures: &'a dyn Fn() -> u64,
}

/// Ends a session with the last evaluation, if the run is complete, and the last metrics and
/// checkpoint.
///
/// # Errors
/// If the last evaluation fails, or the supervisor is gone. The checkpoint is written first.
pub fn close<R: SegmentReceiver, P: ParameterPublisher>(
    session: &mut Session<R, P>,
    recorder: &mut Recorder<'_>,
    supervisor: &dyn Supervisor,
    ending: SessionEnd<'_>,
) -> Result<(), ServeError> {
    let SessionEnd { is_complete, evaluate, env_failures } = ending;
    let mut evaluation = Ok(());
    session.learner.counters.env_failures = env_failures();
    recorder.report_progress(&session.learner);
    if is_complete && recorder.is_unevaluated(&session.learner) {
        session.publish()?;
        // Even if the evaluation fails, the checkpoint is written first.
        evaluation = recorder.due(Due::Evaluation, &mut session.learner, evaluate);
        // In a one-process run the evaluation is finished now, and its failures count.
        session.learner.counters.env_failures = env_failures();
    }
    if recorder.is_unmeasured(&session.learner) {
        recorder.due(Due::Metrics, &mut session.learner, evaluate)?;
    }
    let written = recorder.write_checkpoint(&mut session.learner);
    evaluation?;
    written.map_err(DueError::from)?;
    if supervisor.is_gone() {
        return Err(ServeError::SupervisorGone);
    }
    Ok(supervisor.report(&Report::Finished)?)
}

#[cfg(test)]
mod tests;
