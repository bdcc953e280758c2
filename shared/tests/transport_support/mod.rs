//! Helpers of the transport tests: a run's directory, segments with sequence numbers, conditions
//! with a deadline, and child processes that run this test binary.

#![allow(dead_code, reason = "each test binary uses a part")]

use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::segment::{Segment, SegmentHeader, SegmentLayout};
use dmprl_shared::transport::shared_memory::{Domain, Plan};

/// Time after which a condition has failed, long enough for a loaded machine.
const DEADLINE: Duration = Duration::from_secs(60);
const POLL_PAUSE: Duration = Duration::from_millis(1);

pub const LAYOUT: SegmentLayout =
    SegmentLayout { segment_steps: 5, observation_len: 11, action_len: 3 };
pub const ARCHITECTURE: u64 = 0xA2C;
pub const PARAMETERS_LEN: usize = 5000;

pub fn plan(worker_count: usize, queue_segments: usize) -> Plan {
    Plan {
        run_id: 7,
        architecture_hash: ARCHITECTURE,
        layout: LAYOUT,
        worker_count,
        queue_segments,
        parameters_len: PARAMETERS_LEN,
    }
}

/// A parent directory for domains, removed at the end of the test.
pub struct Parent {
    directory: tempfile::TempDir,
}

impl Parent {
    pub fn new() -> Self {
        let shared_memory = Path::new("/dev/shm");
        let root = if shared_memory.is_dir() { shared_memory.into() } else { std::env::temp_dir() };
        let directory = tempfile::Builder::new().prefix("dt-").tempdir_in(root).unwrap();
        Self { directory }
    }

    pub fn path(&self) -> PathBuf {
        self.directory.path().join("p")
    }

    pub fn domain(&self, token: &str) -> Domain {
        Domain::create(&self.path(), token).unwrap()
    }
}

/// Polls `condition` until it returns a value. Panics after the deadline.
#[track_caller]
pub fn eventually<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    while start.elapsed() < DEADLINE {
        if let Some(value) = condition() {
            return value;
        }
        std::thread::sleep(POLL_PAUSE);
    }
    panic!("not within {DEADLINE:?}: {what}");
}

/// A header with a sequence number.
pub fn header(worker_id: u32, incarnation: u32, sequence: u64) -> SegmentHeader {
    SegmentHeader { worker_id, incarnation, sequence, ..SegmentHeader::default() }
}

/// Fills a block with numbers that depend on the sequence number.
pub fn fill(block: &mut [f32], sequence: u64) {
    for (index, value) in block.iter_mut().enumerate() {
        *value = (sequence % 65_536) as f32 + index as f32;
    }
}

/// Checks that the block has the numbers of the segment's sequence number.
#[track_caller]
pub fn assert_whole(segment: &Segment) {
    let mut expected = vec![0.0; LAYOUT.block_len()];
    fill(&mut expected, segment.header.sequence);
    assert_eq!(segment.block, expected);
}

/// A snapshot whose values all equal its version.
pub fn snapshot(version: u64) -> ParameterSnapshot {
    ParameterSnapshot {
        version,
        env_steps: version * 10,
        architecture_hash: ARCHITECTURE,
        settled: version.is_multiple_of(2),
        values: vec![version as f32; PARAMETERS_LEN],
    }
}

const ROLE: &str = "DMPRL_TEST_ROLE";
const DOMAIN: &str = "DMPRL_TEST_DOMAIN";
const INCARNATION: &str = "DMPRL_TEST_INCARNATION";

/// A child process: this test binary, running only the test `entry`. It is killed on drop.
pub struct Process(Child);

impl Process {
    pub fn start(entry: &str, role: &str, domain: &Path, incarnation: u32) -> Self {
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", entry, "--nocapture", "--test-threads=1"])
            .env(ROLE, role)
            .env(DOMAIN, domain)
            .env(INCARNATION, incarnation.to_string())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        Self(child)
    }

    /// Kills the process with SIGKILL and waits for its end.
    pub fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }

    /// Calls `meanwhile` repeatedly until the process dies. Returns the signal that killed it.
    #[track_caller]
    pub fn died_of(&mut self, mut meanwhile: impl FnMut()) -> Option<i32> {
        let ended = eventually("the child process dies", || {
            meanwhile();
            self.0.try_wait().unwrap()
        });
        ended.signal()
    }

    #[track_caller]
    pub fn assert_alive(&mut self) {
        assert_eq!(self.0.try_wait().unwrap(), None, "the child process has ended");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns role, domain and incarnation in a process that [`Process::start`] started, else `None`.
pub fn role() -> Option<(String, PathBuf, u32)> {
    let role = std::env::var(ROLE).ok()?;
    let incarnation = std::env::var(INCARNATION).unwrap().parse().unwrap();
    Some((role, std::env::var_os(DOMAIN).unwrap().into(), incarnation))
}
