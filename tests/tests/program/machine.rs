//! Failures of the machine: little memory, full or removed shared memory, and a learner that keeps
//! all workers waiting.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use dmprl_tests::program::{
    Process, Running, Workplace, env_steps_of, env_steps_of_checkpoint, executable, rows,
    shared_memory_of, until,
};
use dmprl_tests::skipped::skipped;
use rustix::process::{Pid, Signal};
use serde_json::json;

use crate::isolation::with_shared_memory_of;
use crate::{ENDLESS, train};

/// Processor time of a process per second while a closure runs [clock ticks].
fn ticks_per_s(process: &Process, meanwhile: impl FnOnce()) -> f64 {
    let ticks = || process.cpu_ticks().expect("a living process") as f64;
    let (before, started) = (ticks(), Instant::now());
    meanwhile();
    (ticks() - before) / started.elapsed().as_secs_f64()
}

/// Only checks that it does not spin; `bench transport` measures the exact share.
#[test]
fn a_worker_whose_learner_takes_nothing_sleeps() {
    let place = Workplace::new();
    let run = place.path("run");
    let more = ["--steps", ENDLESS, "--set", "actors.send_deadline_s=0.25"];
    let mut running = place.start(&train("reacher", &run, &more));
    running.until_steps(&run, 2_500);
    let (worker, learner) = (place.process("actor"), place.process("learner"));
    let stepping = ticks_per_s(&worker, || running.until_steps(&run, 2_500 + 10_000));
    learner.signal(Signal::STOP);
    running.until_said("has waited 1 s: its queue is full");
    let blocked = ticks_per_s(&worker, || running.until_said("has waited 4 s"));
    learner.signal(Signal::CONT);
    println!("{stepping:.1} ticks a second while it steps, {blocked:.1} while it waits");
    assert!(blocked < stepping / 2.0, "{blocked} ticks a second while it waits, {stepping} before");
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
}

/// Waits until a process has died of this cause and is restarted.
fn until_death(running: &mut Running, process: &str, cause: &str) {
    running.until(&format!("the death of {process}"), |running| {
        running.events().iter().any(|event| {
            event["event"] == "child_died"
                && event["process"] == process
                && event["next"] == "restart"
                && event["cause"].as_str().is_some_and(|found| found.starts_with(cause))
        })
    });
}

fn end(running: Running, run: &str) {
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
    let last = rows(run, "metrics.jsonl").pop().unwrap();
    let mut refused = last["rejected"].as_object().unwrap().clone();
    refused.remove("duplicate");
    assert!(refused.values().all(|count| count == 0), "{last}");
}

/// Unwritten pages of shared memory are not allocated. If another process has used all memory, the
/// kernel kills the writer.
#[test]
fn a_worker_killed_by_full_shared_memory_is_told_the_cause_and_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let keys = ["actors.queue_segments=8192"].into_iter().flat_map(|key| ["--set", key]);
    let own = ["--steps", ENDLESS, "--workers", "1", "--events", "json"];
    let more = own.into_iter().chain(keys).collect::<Vec<_>>();
    let line = train("reacher", &run, &more).join(" ");
    // Another process on the machine, on request, for at most two minutes.
    let waiting =
        |file: &str| format!("for i in $(seq 2400); do [ -e {file} ] && break; sleep 0.05; done");
    let other = format!(
        "({}; cat /dev/zero > /dev/shm/full; touch filled; {}; rm /dev/shm/full; touch freed) \
         2>/dev/null &",
        waiting("fill"),
        waiting("free")
    );
    let script = format!("{other} exec {} {line}", executable().display());
    let Some(command) = with_shared_memory_of(64 << 10, &script) else { return };
    let mut running = place.start_command(command);
    running.until_steps(&run, 1_000);
    let learner = place.process("learner");
    // The worker reaches pages that it has never used: its queue is long, and the learner takes
    // nothing.
    learner.signal(Signal::STOP);
    let ask = |file: &str, answer: &str| {
        fs::write(place.path(file), "").unwrap();
        until(answer, || Path::new(&place.path(answer)).exists());
    };
    ask("fill", "filled");
    until_death(&mut running, "actor-0", "signal 7 (SIGBUS), perhaps because shared memory");
    ask("free", "freed");
    learner.signal(Signal::CONT);
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 10_000);
    end(running, &run);
    place.assert_no_process();
}

/// A cgroup with little memory, below the test's own; dropping it removes it.
struct Memory {
    group: PathBuf,
}

impl Memory {
    /// Makes a cgroup of version 2 if memory is controlled there, else of version 1; `None` without
    /// the right.
    fn new(bytes: u64) -> Option<Self> {
        let own = fs::read_to_string("/proc/self/cgroup").ok()?;
        let below = |base: &str, path: &str| Path::new(base).join(path.trim_start_matches('/'));
        own.lines().find_map(|line| {
            let mut fields = line.splitn(3, ':').skip(1);
            let (controllers, path) = (fields.next()?, fields.next()?);
            let (parent, limit) = match controllers {
                "" => (below("/sys/fs/cgroup", path), "memory.max"),
                "memory" => (below("/sys/fs/cgroup/memory", path), "memory.limit_in_bytes"),
                _ => return None,
            };
            let group = parent.join(format!("dmprl-test-{}", std::process::id()));
            fs::create_dir(&group).ok()?;
            let memory = Self { group };
            // Dropped, and so removed, because it does not control memory.
            fs::OpenOptions::new()
                .write(true)
                .open(memory.group.join(limit))
                .and_then(|mut file| file.write_all(bytes.to_string().as_bytes()))
                .ok()
                .map(|()| memory)
        })
    }

    fn take(&self, process: Pid) -> std::io::Result<()> {
        fs::write(self.group.join("cgroup.procs"), process.as_raw_nonzero().to_string())
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        // Only after its last process has ended.
        let gone = || fs::remove_dir(&self.group).is_ok() || !self.group.exists();
        if !std::thread::panicking() {
            until("an empty group of processes", gone);
        }
    }
}

/// The kernel kills the process. The run's message names the likely cause.
#[test]
fn a_learner_killed_for_want_of_memory_is_told_so_and_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let skip = || {
        let remedy = "run the tests as root, where it may make cgroups and move processes to them";
        skipped("TEST_CGROUP_REQUIRED", "a learner that the kernel kills for memory", remedy);
    };
    let Some(memory) = Memory::new(512 << 10) else { return skip() };
    let mut running =
        place.start(&train("reacher", &run, &["--steps", ENDLESS, "--events", "json"]));
    running.until_steps(&run, 2_500);
    if memory.take(place.process("learner").id).is_err() {
        return skip();
    }
    until_death(&mut running, "learner", "signal 9 (SIGKILL), perhaps out of memory");
    running.until_event(&json!({ "event": "first_step", "after_restart": true }));
    let steps = env_steps_of(&run).unwrap_or(0);
    running.until_steps(&run, steps + 1_000);
    end(running, &run);
    place.assert_no_process();
}

#[test]
fn shared_memory_that_is_removed_under_a_run_ends_it_with_a_checkpoint() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    running.until_steps(&run, 2_500);
    let [domain] = &shared_memory_of(&run)[..] else { panic!("one domain") };
    let started = Instant::now();
    fs::remove_dir_all(domain).unwrap();
    running.until_said("was removed; do not clear /dev/shm");
    println!("told after {:?}", started.elapsed());
    let reached = env_steps_of(&run).unwrap();
    running.wait().with_status(1).saying("the run's shared memory").saying("dmprl resume");
    place.assert_no_process();
    assert_eq!(shared_memory_of(&run), Vec::<PathBuf>::new());
    let checkpoint = env_steps_of_checkpoint(&run).unwrap();
    assert!(checkpoint >= reached, "a checkpoint at {checkpoint}, metrics up to {reached}");
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(last["lost"], 0, "{last}");
    assert!(last["rejected"].as_object().unwrap().values().all(|count| count == 0), "{last}");
    let end = (checkpoint + 1_000).to_string();
    place.run(&["resume", &run, "--steps", &end]).with_status(0);
}
