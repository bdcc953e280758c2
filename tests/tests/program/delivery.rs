//! Segment log and checkpoints at their limits: full, on a full disk, and with a learner that dies
//! at a bad moment.

use std::fs;
use std::path::Path;
use std::process::Command;

use dmprl_tests::program::{
    Running, Workplace, env_steps, env_steps_of, env_steps_of_checkpoint, executable, json_file,
    rows, shared_memory_of,
};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::{ENDLESS, train};

const LOG: [&str; 2] = ["--set", "delivery.level=log"];
/// Only a full log triggers a checkpoint.
const NO_CHECKPOINTS: [&str; 2] = ["--set", "checkpoint.interval_steps=1000000"];

fn last_metrics(run: &str) -> Value {
    rows(run, "metrics.jsonl").pop().unwrap()
}

/// Ends a run by Ctrl-C and checks that no acknowledged segment is missing.
fn end_without_loss(running: Running, run: &str) {
    running.signal_group(Signal::INT);
    running.wait().with_status(130).saying("checkpoint written");
    assert_no_loss(run);
}

fn assert_no_loss(run: &str) {
    let last = last_metrics(run);
    assert_eq!(last["lost"], 0, "{last}");
    for file in ["metrics.jsonl", "evaluations.jsonl"] {
        let steps = env_steps(&rows(run, file));
        assert!(steps.is_sorted_by(|a, b| a < b), "{file}: {steps:?}");
    }
}

#[test]
fn a_full_segment_log_makes_a_checkpoint_due() {
    const LOG_BYTES_MAX: u64 = 1 << 20;
    let place = Workplace::new();
    let run = place.path("run");
    let limit = format!("delivery.log_bytes_max={LOG_BYTES_MAX}");
    let more = [&LOG[..], &NO_CHECKPOINTS, &["--set", &limit, "--steps", ENDLESS]].concat();
    let mut running = place.start(&train("reacher", &run, &more));
    let log = Path::new(&run).join("segments.log");
    let mut before = 0;
    for _ in 0..2 {
        running.until("a checkpoint although none is due by its steps", |_| {
            // Plus the header of 32 bytes.
            assert!(fs::metadata(&log).map_or(0, |log| log.len()) <= LOG_BYTES_MAX + 32);
            env_steps_of_checkpoint(&run).is_some_and(|steps| steps > before)
        });
        before = env_steps_of_checkpoint(&run).unwrap();
    }
    end_without_loss(running, &run);
    assert_eq!(fs::metadata(&log).unwrap().len(), 32, "the last checkpoint holds all of it");
}

/// Largest file [blocks of 512 bytes]: just enough for the replay of about 3,000 steps. The program
/// sees a full disk, without a mount.
const FILE_BLOCKS_MAX: &str = "400";
/// Segments that a worker keeps until they are acknowledged.
const KEPT: u64 = 64;

/// First no checkpoint can be written, then no log. Then nothing is acknowledged, and the workers
/// wait.
#[test]
fn a_disk_too_full_for_checkpoint_and_log_stops_the_acknowledging_and_loses_nothing() {
    let place = Workplace::new();
    let run = place.path("run");
    let kept = format!("delivery.unacknowledged_segments={KEPT}");
    let keys = ["--set", "actors.send_deadline_s=0.5", "--set", &kept, "--workers", "1"];
    let more = [&LOG[..], &keys, &["--steps", ENDLESS]].concat();
    let mut command = Command::new("sh");
    let script = "trap '' XFSZ; ulimit -f $0; exec \"$@\"";
    command.args(["-c", script, FILE_BLOCKS_MAX]).arg(executable());
    command.args(train("reacher", &run, &more));
    let mut running = place.start_command(command);
    running.until_said("no checkpoint could be written");
    running.until_said("no segment can be acknowledged");
    running.until_said("the learner acknowledges none of its segments");
    running.signal_group(Signal::INT);
    let finished = running.wait().with_status(130).saying("the last checkpoint was not written");
    assert_eq!(finished.said.matches("no segment can be acknowledged").count(), 1, "told once");
    let inserted = last_metrics(&run)["segments"].as_u64().unwrap();
    let state = json_file(&run, "checkpoints/latest/state.json");
    let (steps, in_checkpoint) = (
        state["counters"]["env_steps"].as_u64().unwrap(),
        state["counters"]["segments"].as_u64().unwrap(),
    );

    // After space is freed: checkpoint and log together have everything that was acknowledged.
    let end = (steps + 20_000).to_string();
    let resumed = place.run(&["resume", &run, "--steps", &end]).with_status(0);
    let words = " segments read from the segment log";
    let (before, _) = resumed.said.split_once(words).unwrap_or_else(|| panic!("{}", resumed.said));
    let read: u64 = before.rsplit(' ').next().unwrap().parse().unwrap();
    // The worker kept no more than these; it had forgotten the acknowledged ones.
    let promised = inserted - KEPT;
    assert!(read > 0 && in_checkpoint + read >= promised, "{in_checkpoint} + {read} of {inserted}");
    assert_eq!(last_metrics(&run)["lost"], 0);
    assert_eq!(env_steps_of_checkpoint(&run), Some(steps + 20_000));
}

/// The learner is asked to stop, and killed before it has.
#[test]
fn a_learner_killed_while_it_comes_to_its_end_does_so_after_its_restart() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = [&LOG[..], &NO_CHECKPOINTS, &["--until-return", "-1000", "--steps", ENDLESS]];
    let mut running = place.start(&train("reacher", &run, &more.concat()));
    // No evaluation yet: an evaluation would end the run.
    running.until("an evaluator", |_| place.processes().iter().any(|it| it.role == "evaluator"));
    place.process("evaluator").signal(Signal::STOP);
    let acknowledged = || {
        let last = rows(&run, "metrics.jsonl").pop();
        last.and_then(|last| last["delivery"]["acked"].as_u64()).unwrap_or(0)
    };
    running.until("acknowledged segments", |_| acknowledged() > 0);
    let promised = acknowledged();
    place.process("learner").signal(Signal::STOP);
    place.process("evaluator").signal(Signal::CONT);
    running.until_said("the return has reached -1000");
    place.process("learner").signal(Signal::KILL);
    let finished = running.wait().with_status(0);
    let finished = finished.saying("learner died (signal 9").saying("read from the segment log");
    let last = last_metrics(&run);
    assert_eq!((&last["lost"], &last["learner_restarts"]), (&0.into(), &1.into()), "{last}");
    assert!(last["segments"].as_u64().unwrap() >= promised, "{last}\n{}", finished.said);
    assert_eq!(env_steps_of_checkpoint(&run), last["env_steps"].as_u64());
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<std::path::PathBuf>::new());
}

/// `learner/tests/checkpoint_kill.rs` tests each point of the writing; this test uses the whole
/// program.
#[test]
fn a_learner_killed_in_the_middle_of_a_checkpoint_goes_on_from_the_one_before() {
    const KILLS: usize = 3;
    let place = Workplace::new();
    let run = place.path("run");
    let often = ["--set", "checkpoint.interval_steps=200", "--steps", ENDLESS];
    let more = [&LOG[..], &often, &["--events", "json"]].concat();
    let mut running = place.start(&train("reacher", &run, &more));
    let checkpoints = Path::new(&run).join("checkpoints");
    let half_written = || {
        let names = fs::read_dir(&checkpoints).unwrap().flatten().map(|entry| entry.file_name());
        names.filter(|name| name.to_string_lossy().starts_with(".0")).count()
    };
    for kill in 1..=KILLS {
        let steps = env_steps_of(&run).unwrap_or(0);
        running.until_steps(&run, steps + 1_000);
        running.until("a checkpoint that is being written", |_| {
            let found = half_written() > 0;
            if found {
                place.process("learner").signal(Signal::KILL);
            }
            found
        });
        running.until("the learner's death", |running| {
            let events = running.events();
            // Only the learner's, since an evaluator is killed with the learner that waits for it.
            let is_death =
                |event: &&Value| event["event"] == "child_died" && event["process"] == "learner";
            events.iter().filter(is_death).count() == kill
        });
        running.until("a new learner", |running| {
            let events = running.events();
            events.iter().filter(|event| event["after_restart"] == true).count() == kill
        });
    }
    running.signal_group(Signal::INT);
    let end = json!({ "event": "finished", "checkpointed": true });
    running.wait().with_status(130).with_event(&end);
    assert_no_loss(&run);
    assert_eq!(half_written(), 0, "partial files are removed");
    assert_eq!(last_metrics(&run)["learner_restarts"], KILLS);
}
