//! Tests the supervisor with fake children that hang, crash in a loop, or die occasionally.
#![allow(clippy::unwrap_used)] // helpers of tests fail as tests do

mod fakes;

use std::time::Duration;

use dmprl_supervisor::Ending;
use fakes::Fixture;

fn failure(ending: Ending) -> String {
    match ending {
        Ending::Failed(error) => format!("{error:#}"),
        other => panic!("expected a failure, got {other:?}"),
    }
}

/// The other worker sends heartbeats all the time.
#[test]
fn a_worker_that_gives_no_sign_of_life_is_said_to_hang_and_replaced() {
    let fakes =
        [("actor-0", "freezes-once"), ("actor-1", "beating"), ("learner", "after-restarts")];
    let mut fixture = Fixture::new(&fakes);
    fixture.config.supervision.heartbeat_timeout_s = 3.0;
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    let hung = "actor-0 hung (no heartbeat for 3.";
    for words in [hung, "last activity: waiting for", "restart 1 of 5"] {
        assert!(shown.contains(words), "{words}\n{shown}");
    }
    assert!(!shown.contains("actor-1 hung") && !shown.contains("died"), "{shown}");
    fixture.assert_no_child_lives();
}

/// The worker is started four times with a budget of one restart, as each start worked long enough.
#[test]
fn a_worker_that_worked_for_long_gets_a_new_restart_budget() {
    let fakes = [("actor-0", "dies-after-work"), ("learner", "after-four-starts")];
    let mut fixture = Fixture::new(&fakes);
    fixture.config.actors.restarts_max = 1;
    fixture.limits.proven = Duration::from_millis(200);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert!(shown.matches("actor-0 died (signal 9").count() >= 3, "{shown}");
    assert!(!shown.contains("restart 2 of") && !shown.contains("giving up"), "{shown}");
    // No two starts have the same number.
    let seen = fixture.seen("actor-0");
    let starts: Vec<&str> = seen.lines().filter(|line| line.starts_with("started")).collect();
    assert_eq!(starts[..4], ["started 0", "started 1", "started 2", "started 3"]);
}

#[test]
fn a_worker_that_dies_soon_after_each_start_is_given_up_even_if_it_sent_segments() {
    let fakes = [("actor-0", "dies-before-work"), ("learner", "until-stopped")];
    let mut fixture = Fixture::new(&fakes);
    fixture.config.actors.restarts_max = 2;
    let (_, shown) = fixture.supervise_until("giving up on it after 2 restarts");
    assert!(shown.contains("continuing with 1 of 2 workers"), "{shown}");
}

#[test]
fn a_learner_that_worked_for_long_gets_a_new_restart_budget() {
    let mut fixture = Fixture::new(&[("learner", "dies-after-work")]);
    fixture.config.supervision.learner_restarts_max = 1;
    fixture.limits.proven = Duration::from_millis(200);
    let (report, shown) = fixture.supervise();
    assert!(matches!(report.ending, Ending::Completed), "{:?}\n{shown}", report.ending);
    assert_eq!(report.learner_restarts, 3, "{shown}");
}

/// Regression test: a checkpoint soon after each start once reset the budget, for ever.
#[test]
fn a_learner_that_dies_soon_after_each_start_is_given_up_even_if_it_wrote_a_checkpoint() {
    let mut fixture = Fixture::new(&[("learner", "dies-after-a-checkpoint")]);
    fixture.config.supervision.learner_restarts_max = 2;
    let (report, shown) = fixture.supervise();
    let message = failure(report.ending);
    assert!(message.contains("learner died: signal 9"), "{message}\n{shown}");
    assert_eq!(fixture.seen("learner").matches("started").count(), 3);
}
