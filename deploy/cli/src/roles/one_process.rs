//! The one-process run of `--deterministic`: worker, learner and evaluator in lock-step.
//!
//! The worker runs one segment in each environment with the newest policy. Then the learner takes
//! the segments in order and does all updates that are due. An evaluation runs when it is due.
//! Nothing depends on a clock, so runs with the same seed write identical bytes to `metrics.jsonl`
//! (except its time keys), `evaluations.jsonl` and every checkpoint.

use std::cell::Cell;

use dmprl_actors::environments::report_failures;
use dmprl_actors::evaluate::Evaluator;
use dmprl_actors::evaluator::{self, Answer, Evaluations};
use dmprl_actors::policy_health::PolicyHealth;
use dmprl_actors::rollout::{Identity, Rollout, RolloutError};
use dmprl_actors::worker;
use dmprl_control::{EvaluationRequest, Report};
use dmprl_learner::learner::Learner;
use dmprl_learner::recorder::Recorder;
use dmprl_learner::serve::{SessionEnd, close, request_missed_evaluation};
use dmprl_learner::session::{Due, Session, Turn};
use dmprl_run::Setup;
use dmprl_shared::config::RunConfig;
use dmprl_shared::supervision::Supervisor;
use dmprl_shared::transport::{ParameterSubscriber, SegmentSender, SendOutcome, in_process};

use super::environments::on_hang;
use super::evaluator::keep;
use super::learner_files::{LearnerFiles, past};
use super::{ControlPipe, LearnerArgs};

/// Error of a delivery.
struct Delivery(anyhow::Error);

impl From<RolloutError> for Delivery {
    fn from(error: RolloutError) -> Self {
        Self(error.into())
    }
}

/// Trains in this process until the run is complete or a stop is requested.
pub fn run(args: &LearnerArgs, control: &ControlPipe) -> anyhow::Result<()> {
    let setup = &Setup::read(&args.run)?;
    let config = &setup.config;
    let interpreter = super::actor::start_interpreter(args.venv.as_deref(), config)?;
    let made = worker::environments(&interpreter, config, 0, on_hang(control))?;
    let spec = made.spec().clone();
    let evaluator = evaluator::evaluator(&interpreter, config, on_hang(control))?;
    control.send(&Report::EnvironmentReady { spec: spec.clone() })?;

    let learner = super::learner::make(setup, &spec, args, control)?;
    // A resumed run begins new episodes, so its worker gets a new incarnation.
    let incarnation = u32::try_from(learner.counters.segments)?;
    let identity = Identity { run_id: setup.run_id, worker_id: 0, incarnation, seed_index: 0 };
    let mut rollout = Rollout::start(config, made, identity)?;
    let (queue, layout) = (rollout.segments_max(), learner.policy().layout());
    let (mut senders, receiver) = in_process::segment_queues(1, queue, layout);
    let hash = learner.policy().architecture_hash();
    let (publisher, mut parameters) = in_process::parameter_channel(hash);

    let mut files = LearnerFiles::open(&setup.run, None)?;
    let mut recorder = Recorder::new(&mut files, past(&setup.run)?, control, &learner);
    let mut session = Session::start(learner, receiver, publisher)?;
    control.send(&Report::LearnerReady)?;
    let policy_path = |version| setup.run.policy_path(version);
    let (reached, failures) =
        (&Cell::new(false), &Cell::new(session.learner.counters.env_failures));
    let stop = control.stop_flag();
    let evaluations = Evaluations { config, policy_path: &policy_path, stop };
    let health = PolicyHealth::default();
    let mut inline =
        InlineEvaluator { evaluator, evaluations, health, setup, control, reached, failures };
    let mut evaluate = |request: EvaluationRequest| inline.evaluate(&request).map_err(Into::into);
    request_missed_evaluation(&mut session, &mut recorder, &mut evaluate)?;
    let mut first = true;
    let is_complete = loop {
        let mut due = |due: Due, learner: &mut Learner| {
            let done = recorder.due(due, learner, &mut evaluate);
            // A checkpoint may follow an evaluation at the same step.
            learner.counters.env_failures = failures.get();
            done
        };
        let turn = loop {
            match session.turn(&mut due)? {
                Turn::Worked if !control.stop_requested() => {}
                turn => break turn,
            }
        };
        recorder.progress(&session.learner);
        if control.stop_requested() {
            break false;
        }
        // Check for the goal here, so that the run always ends at the same step.
        if turn == Turn::Finished || reached.get() || control.finish_requested() {
            break true;
        }
        parameters.newest(&mut rollout.snapshot)?;
        let acted = act(&mut rollout, &mut senders[0]);
        count(failures, report_failures(&rollout.take_failures(), control));
        session.learner.counters.env_failures = failures.get();
        acted?;
        if std::mem::take(&mut first) {
            let _ = control.send(&Report::FirstSegment);
        }
    };
    let env_failures = || failures.get();
    let ending = SessionEnd { is_complete, evaluate: &mut evaluate, env_failures: &env_failures };
    Ok(close(&mut session, &mut recorder, control, ending)?)
}

/// Evaluates a policy in this process when an evaluation is due.
struct InlineEvaluator<'a> {
    evaluator: Evaluator,
    evaluations: Evaluations<'a>,
    health: PolicyHealth,
    setup: &'a Setup,
    control: &'a ControlPipe,
    /// Set after an evaluation has reached the run's goal.
    reached: &'a Cell<bool>,
    failures: &'a Cell<u64>,
}

impl InlineEvaluator<'_> {
    fn evaluate(&mut self, request: &EvaluationRequest) -> anyhow::Result<()> {
        let answer = evaluator::evaluate(&mut self.evaluator, &self.evaluations, request);
        count(self.failures, report_failures(&self.evaluator.take_failures(), self.control));
        let row = match answer? {
            Answer::Row(row) => row,
            Answer::Failed(reason) => {
                let policy_version = request.policy_version;
                let _ = self.control.send(&Report::NotEvaluated { policy_version, reason });
                return Ok(());
            }
            Answer::Stopped => return Ok(()),
        };
        keep(self.setup, &row, self.control)?;
        let RunConfig { until_return, until_success, .. } = self.evaluations.config.run;
        let success = row.success_rate.is_some_and(|rate| rate >= until_success);
        self.reached.set(self.reached.get() || success || row.return_mean >= until_return);
        // If the supervisor is gone, the loop notices it as a stop.
        for message in self.health.check(&row) {
            let _ = self.control.send(&Report::Warning { message });
        }
        let _ = self.control.send(&Report::Evaluated(row));
        Ok(())
    }
}

fn count(sum: &Cell<u64>, more: u64) {
    sum.set(sum.get() + more);
}

/// Runs one segment in each environment. The learner has emptied the queue, so all segments fit.
fn act(rollout: &mut Rollout, sender: &mut in_process::Sender) -> anyhow::Result<()> {
    rollout
        .segment(&mut |header, block| match sender.try_send(header, block) {
            Ok(SendOutcome::Delivered) => Ok(()),
            Ok(outcome) => Err(Delivery(anyhow::anyhow!(
                "the learner should have emptied the queue, but sending returned {outcome:?}"
            ))),
            Err(error) => Err(Delivery(error.into())),
        })
        .map_err(|Delivery(error)| error)
}
