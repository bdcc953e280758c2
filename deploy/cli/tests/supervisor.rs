//! Tests the supervisor with fake children: completion, deaths, interrupts and deadlines.
#![allow(clippy::unwrap_used)] // helpers of tests fail as tests do

mod fakes;

use std::time::Duration;

use dmprl_supervisor::{Ending, TimeLimits};
use fakes::{Fixture, PATIENCE};

fn failure(ending: Ending) -> String {
    match ending {
        Ending::Failed(error) => format!("{error:#}"),
        other => panic!("expected a failure, got {other:?}"),
    }
}

#[test]
fn a_run_completes_when_the_learner_is_done_and_all_evaluations_are_answered() {
    let fixture = Fixture::new(&[]);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert!(report.checkpointed);
    assert_eq!(report.last.unwrap().env_steps, 10);
    assert_eq!(report.last_row.unwrap().policy_version, 2);
    assert!(fixture.seen("actor-0").contains("\"attach\""), "{}", fixture.seen("actor-0"));
    assert!(fixture.seen("actor-1").contains("stop"));
    assert_eq!(fixture.run.spec().unwrap().unwrap().id, "Fake-v0");
    assert!(shown.contains("checkpoint 001"), "{shown}");
    assert!(shown.contains("return -3.00 ± 1.00, success 50 %"), "{shown}");
    fixture.assert_no_child_lives();
}

#[test]
fn one_process_needs_neither_workers_nor_evaluator() {
    let mut fixture = Fixture::new(&[]);
    fixture.one_process = true;
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert_eq!(report.last_row.unwrap().policy_version, 1);
    assert_eq!((fixture.seen("actor-0"), fixture.seen("evaluator")), Default::default());
}

#[test]
fn the_run_completes_when_an_evaluation_reaches_the_target() {
    let mut fixture = Fixture::new(&[("learner", "until-stopped")]);
    fixture.config.run.until_return = -3.0;
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert!(report.checkpointed && shown.contains("the return has reached -3"), "{shown}");
}

#[test]
fn the_run_completes_when_its_time_has_elapsed() {
    let mut fixture = Fixture::new(&[("learner", "until-stopped")]);
    fixture.config.run.max_minutes = 1e-6;
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert!(shown.contains("run.max_minutes has elapsed"), "{shown}");
}

#[test]
fn a_worker_that_dies_is_restarted_with_the_next_incarnation() {
    let fixture = Fixture::new(&[("actor-0", "dies-once"), ("learner", "after-restarts")]);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert!(shown.contains("actor-0 died (signal 9 (SIGKILL)"), "{shown}");
    assert!(shown.contains("restart 1 of 5") && shown.contains("logs/actor-0.log"), "{shown}");
}

#[test]
fn a_worker_that_keeps_dying_is_given_up_and_the_others_continue() {
    let mut fixture = Fixture::new(&[("actor-0", "dies"), ("learner", "until-stopped")]);
    fixture.config.actors.restarts_max = 2;
    let (report, shown) = fixture.supervise_until("giving up on it after 2 restarts");
    assert!(matches!(report.ending, Ending::Interrupted), "{:?}\n{shown}", report.ending);
    assert!(shown.contains("actor-0 died (exit status 3) again"), "{shown}");
    assert!(shown.contains("continuing with 1 of 2 workers"), "{shown}");
    let log_tail = shown.split("continuing with 1 of 2 workers").nth(1).unwrap();
    assert!(log_tail.contains("logs/actor-0.log:\n"), "{shown}");
    assert!(log_tail.contains("error: out of luck"), "{shown}");
    assert_eq!(fixture.seen("actor-0").matches("started").count(), 3);
}

#[test]
fn without_any_worker_left_the_run_stops_with_a_checkpoint_and_advice() {
    let fakes = [("actor-0", "dies"), ("actor-1", "dies"), ("learner", "until-stopped")];
    let mut fixture = Fixture::new(&fakes);
    fixture.config.actors.restarts_max = 1;
    let (report, shown) = fixture.supervise();
    assert!(report.checkpointed, "{shown}");
    let message = failure(report.ending);
    assert!(message.contains("no worker is left") && message.contains("dmprl resume"), "{message}");
}

#[test]
fn an_environment_that_cannot_be_created_ends_the_run_at_once_with_its_reason() {
    let fixture = Fixture::new(&[("actor-0", "refused"), ("actor-1", "silent")]);
    let (report, _) = fixture.supervise();
    let message = failure(report.ending);
    assert!(message.contains("error: no environment Fake-v0"), "{message}");
    assert_eq!(fixture.seen("actor-0").matches("started").count(), 1);
}

#[test]
fn a_learner_that_dies_once_is_replaced_and_its_workers_stay() {
    let fixture = Fixture::new(&[("learner", "dies-once"), ("evaluator", "slow-once")]);
    std::fs::create_dir(fixture.run.checkpoints_path().join("000001")).unwrap();
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert_eq!((report.learner_restarts, report.checkpointed), (1, true));
    assert!(shown.contains("learner died (signal 9 (SIGKILL)"), "{shown}");
    assert!(shown.contains("the learner is back: first segment"), "{shown}");
    assert!(fixture.seen("learner").contains("started resumed"), "{}", fixture.seen("learner"));
    for actor in ["actor-0", "actor-1"] {
        let seen = fixture.seen(actor);
        assert_eq!((seen.matches("started").count(), seen.matches("attach").count()), (1, 1));
    }
    // The evaluation in flight is given up, and the next one is answered.
    assert_eq!(fixture.seen("evaluator").matches("policy_version\":1").count(), 1);
    assert_eq!(report.last_row.unwrap().policy_version, 2);
    fixture.assert_no_child_lives();
}

#[test]
fn a_learner_that_fails_at_its_start_is_not_restarted() {
    let fixture = Fixture::new(&[("learner", "refuses")]);
    let message = failure(fixture.supervise().0.ending);
    assert!(message.contains("error: no such checkpoint"), "{message}");
    assert_eq!(fixture.seen("learner").matches("started").count(), 1);
}

#[test]
fn a_learner_that_keeps_dying_ends_the_run_with_its_log_and_advice() {
    let mut fixture = Fixture::new(&[("learner", "dies")]);
    fixture.config.supervision.learner_restarts_max = 2;
    std::fs::create_dir(fixture.run.checkpoints_path().join("000001")).unwrap();
    let (report, shown) = fixture.supervise();
    assert!(shown.contains("restart 2 of 2"), "{shown}");
    assert_eq!(fixture.seen("learner").matches("started").count(), 3);
    let message = failure(report.ending);
    for part in ["learner died: signal 9", "logs/learner.log", "log line 20", "dmprl resume"] {
        assert!(message.contains(part), "{part}: {message}");
    }
    assert!(!message.contains("log line 5\n"), "15 lines are enough: {message}");
    fixture.assert_no_child_lives();
}

#[test]
fn without_a_checkpoint_a_failure_does_not_suggest_to_resume() {
    let fixture = Fixture::new(&[("learner", "dies")]);
    let message = failure(fixture.supervise().0.ending);
    assert!(!message.contains("dmprl resume"), "{message}");
}

#[test]
fn a_dead_evaluator_is_restarted_and_asked_again() {
    let fixture = Fixture::new(&[("evaluator", "dies-once")]);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert_eq!(report.last_row.unwrap().policy_version, 2);
    assert_eq!(fixture.seen("evaluator").matches("policy_version\":1").count(), 2);
}

#[test]
fn an_evaluator_that_keeps_dying_ends_the_run() {
    let fixture = Fixture::new(&[("evaluator", "dies"), ("learner", "until-stopped")]);
    let (report, shown) = fixture.supervise();
    assert!(report.checkpointed, "{shown}");
    let message = failure(report.ending);
    assert!(message.contains("evaluator died: exit status 4"), "{message}");
}

#[test]
fn a_failed_evaluation_is_reported_and_skipped() {
    let fixture = Fixture::new(&[("evaluator", "fails-once")]);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert_eq!(report.last_row.unwrap().policy_version, 2);
    assert!(shown.contains("no evaluation of policy 1"), "{shown}");
    assert!(shown.contains("its episode failed twice; log: "), "{shown}");
    assert_eq!(fixture.seen("evaluator").matches("started").count(), 1);
}

/// The learner finishes when it has received the count of all five failures.
#[test]
fn environment_failures_are_summed_and_each_doubling_is_shown() {
    let fakes = [("actor-0", "failing"), ("learner", "until-five-failures")];
    let (report, shown) = Fixture::new(&fakes).supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert_eq!(report.env_failures, 5);
    let is_shown =
        |count| shown.contains(&format!("actor-0: environment failure {count}: the gripper"));
    assert_eq!([1, 2, 3, 4, 5].map(is_shown), [true, true, false, false, true], "{shown}");
    assert!(shown.contains("logs/actor-0.log"), "{shown}");
}

fn never_ready(name: &str) {
    let mut fixture = Fixture::new(&[("learner", "until-stopped"), (name, "silent")]);
    fixture.limits.ready = Duration::from_secs(3);
    let (report, _) = fixture.supervise();
    let message = failure(report.ending);
    assert!(message.contains(&format!("{name} was not ready within 3s")), "{message}");
    assert!(message.contains(&format!("logs/{name}.log")), "{message}");
    fixture.assert_no_child_lives();
}

#[test]
fn a_worker_that_is_never_ready_is_named_with_its_log() {
    never_ready("actor-1");
}

#[test]
fn a_learner_that_is_never_ready_is_named_with_its_log() {
    never_ready("learner");
}

#[test]
fn an_evaluator_that_is_never_ready_is_named_with_its_log() {
    never_ready("evaluator");
}

#[test]
fn a_run_that_neither_steps_nor_updates_is_stopped() {
    let mut fixture = Fixture::new(&[("learner", "until-stopped")]);
    fixture.limits.stall = Duration::from_millis(300);
    fixture.limits.evaluation = Duration::ZERO;
    let (report, _) = fixture.supervise();
    let message = failure(report.ending);
    assert!(message.contains("neither a step nor an update"), "{message}");
}

#[test]
fn one_interrupt_lets_the_learner_write_its_checkpoint() {
    let fixture = Fixture::new(&[("learner", "until-stopped")]);
    let (report, shown) = fixture.supervise_until("evaluation at 10 steps");
    assert!(matches!(report.ending, Ending::Interrupted), "{:?}\n{shown}", report.ending);
    assert!(report.checkpointed, "{shown}");
    fixture.assert_no_child_lives();
}

#[test]
fn a_child_that_does_not_stop_in_time_is_killed_and_named() {
    let mut fixture = Fixture::new(&[("learner", "until-stopped"), ("actor-1", "stubborn")]);
    fixture.limits.stop = Duration::from_secs(3);
    let (report, shown) = fixture.supervise_until("evaluation at 10 steps");
    assert!(matches!(report.ending, Ending::Interrupted), "{:?}\n{shown}", report.ending);
    assert!(report.checkpointed && shown.contains("killed actor-1"), "{shown}");
    fixture.assert_no_child_lives();
}

#[test]
fn a_second_interrupt_kills_at_once() {
    let mut fixture = Fixture::new(&[("learner", "until-stopped"), ("actor-0", "stubborn")]);
    // Longer than the test's time limit: only the second interrupt can end the run.
    fixture.limits = TimeLimits { stop: PATIENCE * 10, ..fixture.limits };
    fixture.interrupted_twice = true;
    let (report, shown) = fixture.supervise_until("evaluation at 10 steps");
    assert!(matches!(report.ending, Ending::Interrupted), "{:?}\n{shown}", report.ending);
    assert!(shown.contains("interrupted twice: killed actor-0"), "{shown}");
    fixture.assert_no_child_lives();
}

#[test]
fn output_of_an_environment_is_shown_and_harmless() {
    let fixture = Fixture::new(&[("actor-0", "noisy")]);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert!(shown.contains("hello from print()"), "{shown}");
}

#[test]
fn a_resumed_run_with_a_changed_environment_fails() {
    let fixture = Fixture::new(&[]);
    let mut spec = fixture.spec();
    spec.observation_len = 3;
    fixture.run.write_spec(&spec).unwrap();
    let (report, _) = fixture.supervise();
    let message = failure(report.ending);
    assert!(
        message.contains("differs from the run's: observation_len: expected 3, got"),
        "{message}"
    );
}
