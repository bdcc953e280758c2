//! Kills a learner with SIGKILL at every point of writing a checkpoint, and checks the remaining
//! files.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use dmprl_learner::checkpoint::{Writer, load_newest, names};
use dmprl_learner::learner::{Learner, LearnerError};
use dmprl_shared::config::Layers;
use dmprl_shared::segment::{LAYOUT_VERSION, Segment, SegmentHeader, TRUNCATED, block_checksum};
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::delivery::{LogIdentity, SegmentLog};
use serde_json::Value;

const ENTRY: &str = "another_process_plays_the_learner";
const FOLDER: &str = "DMPRL_TEST_FOLDER";
const RUN_ID: u64 = 5;
/// Segments between two checkpoints.
const INTERVAL: u64 = 16;
/// Minimum number of kills. The test continues until every point was hit, up to [`KILLS_MAX`].
const KILLS_MIN: u32 = 40;
const KILLS_MAX: u32 = 2_000;
/// Files in `latest` if it is a folder. The writer deletes them between renaming the checkpoint and
/// pointing `latest` at it, which takes long enough to be hit.
const LATEST_FILES: u32 = 1_000;
/// A learner is killed at a random time within this limit after its first acknowledgement.
const KILLED_WITHIN_US: u64 = 3_000;
/// Maximum wait for the file whose appearance triggers a kill; after that it has been missed.
const LOOKED_FOR: Duration = Duration::from_millis(50);
/// Maximum wait for a learner's first acknowledgement.
const ACKNOWLEDGED_WITHIN: Duration = Duration::from_secs(60);
/// Length of the segment log's header [bytes].
const LOG_HEAD: usize = 32;
/// Length of a record before the segment's header [bytes].
const RECORD_HEAD: usize = 8;

fn fresh() -> Result<Learner, LearnerError> {
    let mut layers = Layers::new();
    let small = [
        ("policy.hidden", "[8]"),
        ("algorithm.critic_hidden", "[8]"),
        ("replay.capacity_steps", "1000"),
        ("actors.workers", "1"),
        ("actors.envs_per_worker", "1"),
        ("learner.threads", "1"),
        ("checkpoint.keep", "2"),
    ];
    for (key, value) in small {
        layers.set("test", key, value).unwrap();
    }
    let spec = EnvSpec::new("Test-v0", 4, &[(-1.0, 1.0); 2], 0.02, 10);
    Learner::new(layers.finish().unwrap(), &spec, RUN_ID)
}

/// Returns the segment with this sequence number, always the same.
fn segment(learner: &Learner, sequence: u64) -> Segment {
    let layout = learner.policy().layout();
    let mut segment = Segment::zeroed(layout);
    segment.block.fill(sequence as f32 % 1000.0 / 1000.0);
    segment.header = SegmentHeader {
        layout_version: LAYOUT_VERSION,
        flags: TRUNCATED,
        run_id: RUN_ID,
        architecture_hash: learner.policy().architecture_hash(),
        sequence,
        episode: sequence as u32,
        steps_len: 5,
        segment_steps: 5,
        observation_len: layout.observation_len as u32,
        action_len: layout.action_len as u32,
        checksum: block_checksum(&segment.block),
        ..SegmentHeader::default()
    };
    segment
}

fn checkpoints(folder: &Path) -> PathBuf {
    folder.join("checkpoints")
}

fn log_path(folder: &Path) -> PathBuf {
    folder.join("segments.log")
}

/// Recovers like the program's learner: the newest usable checkpoint, then the log.
fn recovered(folder: &Path) -> Learner {
    let mut learner = match names(&checkpoints(folder)).unwrap().is_empty() {
        true => fresh().unwrap(),
        false => load_newest(&checkpoints(folder), &fresh).unwrap().0,
    };
    let architecture_hash = learner.policy().architecture_hash();
    let identity = LogIdentity { run_id: RUN_ID, architecture_hash };
    let layout = learner.policy().layout();
    let log = SegmentLog::open(&log_path(folder), identity, layout, 1 << 24).unwrap();
    learner.recover(log).unwrap();
    learner
}

fn settled(learner: &Learner) -> u64 {
    learner.inbox.settled()[0].sequence
}

#[test]
fn another_process_plays_the_learner() {
    let Some(folder) = std::env::var_os(FOLDER).map(PathBuf::from) else { return };
    let mut learner = recovered(&folder);
    let acknowledged = File::options().write(true).open(folder.join("acknowledged")).unwrap();
    let mut writer = Writer::new(checkpoints(&folder));
    loop {
        let next = settled(&learner) + 1;
        learner.insert(&segment(&learner, next)).unwrap();
        let mark = learner.inbox.acknowledge().unwrap()[0].sequence;
        acknowledged.write_all_at(&mark.to_le_bytes(), 0).unwrap();
        if let Some(outcome) = writer.poll(&mut learner) {
            outcome.result.unwrap();
        }
        if !writer.is_busy() && next.is_multiple_of(INTERVAL) {
            writer.begin(&mut learner).unwrap();
        }
    }
}

struct Process(Child);

impl Process {
    fn start(folder: &Path) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", ENTRY, "--nocapture", "--test-threads=1"]);
        command.env(FOLDER, folder).stdout(Stdio::null());
        Self(command.spawn().unwrap())
    }
}

impl Drop for Process {
    /// Kills the process and waits for it.
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn acknowledged(folder: &Path) -> u64 {
    let bytes = fs::read(folder.join("acknowledged")).unwrap();
    u64::from_le_bytes(bytes.try_into().unwrap())
}

/// Numbers of kills at each point, inferred from the files that remained.
#[derive(Debug, Default)]
struct PointsHit {
    in_the_middle: u32,
    before_the_rename: u32,
    before_latest: u32,
    before_the_log_forgot: u32,
}

impl PointsHit {
    fn all(&self) -> bool {
        let counts = [
            self.in_the_middle,
            self.before_the_rename,
            self.before_latest,
            self.before_the_log_forgot,
        ];
        counts.iter().all(|&count| count > 0)
    }

    fn inspect(&mut self, folder: &Path) {
        let checkpoints = checkpoints(folder);
        let state = |name: &str| -> Option<Value> {
            serde_json::from_slice(&fs::read(checkpoints.join(name).join("state.json")).ok()?).ok()
        };
        for entry in fs::read_dir(&checkpoints).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            if name.starts_with(".0") {
                let whole = state(&name).is_some();
                *(if whole { &mut self.before_the_rename } else { &mut self.in_the_middle }) += 1;
            }
        }
        let Some(newest) = names(&checkpoints).unwrap().pop() else { return };
        let latest = fs::read_link(checkpoints.join("latest")).ok();
        self.before_latest += u32::from(latest.is_none_or(|latest| latest != Path::new(&newest)));
        let held = state(&newest).unwrap()["settled"][0]["sequence"].as_u64().unwrap();
        let log = fs::read(log_path(folder)).unwrap();
        let first = log.get(LOG_HEAD + RECORD_HEAD..).and_then(|rest| rest.get(..80));
        let first = first.map(bytemuck::pod_read_unaligned::<SegmentHeader>);
        self.before_the_log_forgot += u32::from(first.is_some_and(|first| first.sequence <= held));
    }
}

/// Makes a folder in memory, if the system has one.
fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    let folder = tempfile::Builder::new().prefix("dk-").tempdir_in(parent).unwrap();
    fs::create_dir(checkpoints(folder.path())).unwrap();
    let options = OpenOptions::new().write(true).create(true).truncate(true).to_owned();
    let file = options.open(folder.path().join("acknowledged")).unwrap();
    file.write_all_at(&[0; 8], 0).unwrap();
    folder
}

/// Returns the file whose appearance triggers the kill, or `None` for a random time.
fn trigger(folder: &Path, kill: u32) -> Option<PathBuf> {
    let checkpoints = checkpoints(folder);
    let newest = names(&checkpoints).unwrap().pop().map_or(0, |name| name.parse().unwrap());
    let next: u64 = newest + 1;
    let written = checkpoints.join(format!(".{next:06}.tmp"));
    match kill % 4 {
        0 => None,
        1 => Some(written.join("replay.bin")),
        2 => Some(written.join("state.json")),
        _ => {
            fill_latest(&checkpoints.join("latest"));
            Some(checkpoints.join(format!("{next:06}")))
        }
    }
}

/// Replaces `latest` by a folder with many files, like a copy made without symbolic links.
fn fill_latest(latest: &Path) {
    let _ = fs::remove_file(latest).or_else(|_| fs::remove_dir_all(latest));
    fs::create_dir(latest).unwrap();
    (0..LATEST_FILES).for_each(|index| fs::write(latest.join(index.to_string()), "").unwrap());
}

fn replay_bytes(learner: &Learner) -> Vec<u8> {
    let mut bytes = Vec::new();
    learner.replay.write(&mut bytes).unwrap();
    bytes
}

#[test]
fn killed_at_any_point_of_a_checkpoint_it_has_everything_once() {
    let folder = folder();
    let folder = folder.path();
    // Never killed; every recovered learner must equal it.
    let mut reference = fresh().unwrap();
    let mut hit = PointsHit::default();
    let mut kills = 0;
    while kills < KILLS_MIN || !hit.all() && kills < KILLS_MAX {
        let before = acknowledged(folder);
        let trigger = trigger(folder, kills);
        let mut process = Process::start(folder);
        let started = Instant::now();
        while acknowledged(folder) == before {
            assert_eq!(process.0.try_wait().unwrap(), None, "the learner exited");
            assert!(started.elapsed() < ACKNOWLEDGED_WITHIN, "the learner acknowledged nothing");
            std::thread::yield_now();
        }
        match &trigger {
            Some(path) => {
                // The file may be gone already; then this kills at a random time.
                let begun = Instant::now();
                while path.symlink_metadata().is_err() && begun.elapsed() < LOOKED_FOR {
                    std::hint::spin_loop();
                }
            }
            // The time of the kill is the injected fault; the test does not depend on it.
            None => std::thread::sleep(Duration::from_micros(
                u64::from(kills) * 7_919 % KILLED_WITHIN_US,
            )),
        }
        drop(process);
        kills += 1;
        hit.inspect(folder);
        let learner = recovered(folder);
        let has = settled(&learner);
        assert!(has >= acknowledged(folder), "{has} of {}", acknowledged(folder));
        while settled(&reference) < has {
            reference.insert(&segment(&reference, settled(&reference) + 1)).unwrap();
        }
        let counters = learner.counters;
        assert_eq!((settled(&reference), counters.segments, counters.lost), (has, has, 0));
        assert!(replay_bytes(&learner) == replay_bytes(&reference), "after {kills} kills");
    }
    println!("{kills} kills: {hit:?}");
    assert!(hit.all(), "a point was never hit in {kills} kills: {hit:?}");
}
