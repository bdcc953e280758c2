//! A run directory on a file system whose locks are absent, or hold only within a host.

use std::fs::{self, File};
use std::path::Path;
use std::process::Command;

use dmprl_tests::program::{Running, Workplace, env_steps_of, executable};
use dmprl_tests::skipped::skipped;
use rustix::process::Signal;

use crate::{ENDLESS, train};

/// Takes the locks away from the file `run/lock` of the workplace. All other files keep them.
const NO_LOCKS: &str = r#"
#define _GNU_SOURCE
#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

int flock(int file, int operation) {
    char link[64], path[4096];
    const char *end = "/run/lock";
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path);
    size_t end_length = strlen(end);
    if (length >= (ssize_t)end_length && !memcmp(path + length - end_length, end, end_length)) {
        errno = ENOLCK;
        return -1;
    }
    return syscall(SYS_flock, file, operation);
}
"#;

/// Starts `dmprl` as on a file system without locks.
fn start_without_locks(place: &Workplace, arguments: &[&str]) -> Running {
    let library = place.path("no_locks.so");
    if !Path::new(&library).exists() {
        let source = place.path("no_locks.c");
        fs::write(&source, NO_LOCKS).unwrap();
        // Rust links with the same compiler.
        let made = Command::new("cc").args(["-shared", "-fPIC", "-o", &library, &source]).status();
        assert!(made.unwrap().success());
    }
    let mut command = Command::new(executable());
    command.args(arguments).env("LD_PRELOAD", &library);
    place.start_command(command)
}

#[test]
fn without_file_locks_a_second_trainer_is_refused_and_a_crashed_one_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    let start = |arguments: &[&str]| start_without_locks(&place, arguments);
    let mut running = start(&train("reacher", &run, &["--steps", ENDLESS]));
    running.until_steps(&run, 1_500);
    let lock = File::open(Path::new(&run).join("lock")).unwrap();
    lock.try_lock().expect("nobody holds a file lock");
    drop(lock);
    let holder = format!("is being trained by process {} on host ", running.id());
    let refused = start(&["resume", &run]).wait().with_status(1).saying(&holder);
    assert!(!refused.said.contains("waiting"), "{}", refused.said);
    // The learner of a killed supervisor writes a last checkpoint, and is waited for.
    place.process("learner").signal(Signal::STOP);
    running.signal(Signal::KILL);
    running.wait();
    let reached = env_steps_of(&run).unwrap();
    let mut resuming = start(&["resume", &run]);
    resuming.until_said("waiting up to");
    place.process("learner").signal(Signal::CONT);
    resuming.until_steps(&run, reached + 1_000);
    resuming.signal_group(Signal::INT);
    resuming.wait().with_status(130);
    place.assert_no_process();
}

/// Processes in their own namespaces of host names and process ids look like those of another host.
#[test]
fn a_trainer_on_another_host_is_refused_where_file_locks_are_local() {
    let namespaces = ["--uts", "--pid", "--fork", "--mount-proc", "--kill-child"];
    let unshare = || {
        let mut command = Command::new("unshare");
        command.args(namespaces);
        command
    };
    if !unshare().arg("true").status().is_ok_and(|status| status.success()) {
        let remedy = "run the tests as root, with unshare (apt install util-linux)";
        return skipped("TEST_ROOT_REQUIRED", "a run directory shared by two hosts", remedy);
    }
    let place = Workplace::new();
    let run = place.path("run");
    let script = "echo elsewhere > /proc/sys/kernel/hostname && exec \"$@\"";
    let mut command = unshare();
    command.args(["sh", "-c", script, "sh"]).arg(executable());
    command.args(train("reacher", &run, &["--steps", ENDLESS]));
    let mut running = place.start_command(command);
    running.until_steps(&run, 500);
    // A file of its own has its own lock, as on this host if locks are local.
    fs::remove_file(Path::new(&run).join("lock")).unwrap();
    let resumed = place.run(&["resume", &run]).with_status(1);
    resumed.saying("watching its lease").saying(" on host elsewhere; stop it");
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 500);
    drop(running);
    place.until_no_process();
}

/// A supervisor that was suspended, or cut off from the file system, while another host took over.
#[test]
fn a_run_that_was_taken_over_ends_at_once() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    running.until_steps(&run, 500);
    let lease = Path::new(&run).join("lease.1");
    let taker = fs::read_to_string(&lease).unwrap().replacen("\"pid\":", "\"pid\":9", 1);
    fs::write(Path::new(&run).join("lease.2"), taker).unwrap();
    let ended = running.wait().with_status(1);
    ended.saying("error: process 9").saying("has taken the run over");
    place.assert_no_process();
}
