//! Many starts and stops in a row leave no process and no shared memory behind.

use dmprl_tests::program::{Workplace, shared_memory_of};
use rustix::process::Signal;
use serde_json::json;

use crate::{ENDLESS, train};

/// Enough for every test run; `TEST_START_STOP_COUNT=100` for a long one.
const COUNT: usize = 10;

fn has_role(place: &Workplace, role: &str) -> bool {
    place.processes().iter().any(|process| process.role == role)
}

#[test]
fn starts_and_stops_in_a_row_leave_no_process_and_no_byte() {
    let count = std::env::var("TEST_START_STOP_COUNT").map_or(COUNT, |text| text.parse().unwrap());
    let mut runs = Vec::new();
    let place = Workplace::new();
    for index in 0..count {
        let run = place.path(&index.to_string());
        let mut running =
            place.start(&train("reacher", &run, &["--steps", ENDLESS, "--events", "json"]));
        // Each a little later than the last, from before the first child until well into training.
        match index % 5 {
            0 => running.until_event(&json!({ "event": "started" })),
            1 => running.until("a worker", |_| has_role(&place, "actor")),
            2 => running.until("a learner", |_| has_role(&place, "learner")),
            3 => running.until_event(&json!({ "event": "first_step" })),
            _ => running.until_steps(&run, 1_000),
        }
        // Every other one by SIGKILL, after which the next start cleans up.
        if index % 2 == 0 {
            running.signal_group(Signal::INT);
            running.wait().with_status(130);
            place.assert_no_process();
            assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new(), "{index}");
        } else {
            running.signal_group(Signal::KILL);
            drop(running);
            place.until_no_process();
        }
        runs.push(run);
    }
    let last = place.path("last");
    place.run(&train("reacher", &last, &["--steps", "500"])).with_status(0);
    runs.push(last);
    for run in runs {
        assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new(), "{run}");
    }
    place.assert_no_process();
}
