//! Samples the run's resources over time: memory, files, maps, shared memory.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use dmprl_supervisor::Place;
use dmprl_supervisor::members::holdings;
use rustix::process::Pid;
use serde_json::{Value, json};

/// Interval between two samples [us].
const INTERVAL_US: u64 = 1_000_000;
/// Minimum number of samples to judge growth.
const SAMPLES_MIN: usize = 9;

/// Values in the order of sampling; four hours have 14 400.
#[derive(Debug, Clone, Default)]
struct Series(Vec<f64>);

impl Series {
    /// Median of the last third divided by the median of the first.
    fn ratio(&self) -> Option<f64> {
        let third = self.0.len() / 3;
        if self.0.len() < SAMPLES_MIN {
            return None;
        }
        let (first, last) = (median(&self.0[..third])?, median(&self.0[self.0.len() - third..])?);
        (first > 0.0).then_some(last / first)
    }

    fn summary(&self) -> Value {
        let max = self.0.iter().copied().reduce(f64::max);
        json!({ "samples": self.0.len(), "median": median(&self.0), "max": max,
                "ratio": self.ratio() })
    }
}

/// The middle value; the upper of two.
pub(super) fn median(numbers: &[f64]) -> Option<f64> {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

/// Samples of one kind of process.
#[derive(Debug, Clone, Default)]
struct Kind {
    rss: Series,
    fds: Series,
    maps: Series,
}

impl Kind {
    fn add(&mut self, pid: Pid) {
        if let Some(held) = holdings(pid) {
            self.rss.0.push(held.rss_kib as f64);
            self.fds.0.push(held.fds as f64);
            self.maps.0.push(held.maps as f64);
        }
    }

    fn summary(&self) -> Value {
        let Self { rss, fds, maps } = self;
        json!({ "rss_kib": rss.summary(), "fds": fds.summary(), "maps": maps.summary() })
    }
}

/// Samples of supervisor, learner and shared memory.
#[derive(Debug, Clone)]
pub(super) struct Samples {
    run_id: String,
    next_us: u64,
    supervisor: Kind,
    learner: Kind,
    shm: Series,
}

impl Samples {
    pub(super) fn new(run_id: String) -> Self {
        let (supervisor, learner) = (Kind::default(), Kind::default());
        Self { run_id, next_us: 0, supervisor, learner, shm: Series::default() }
    }

    /// Returns true if the next sample is due.
    pub(super) fn is_due(&self, now_us: u64) -> bool {
        now_us >= self.next_us
    }

    /// Takes a sample. `learner` is `None` unless a learner is working and its replay is full; then
    /// shared memory is sampled too.
    pub(super) fn take(&mut self, now_us: u64, supervisor: Pid, learner: Option<Pid>) {
        self.next_us = now_us + INTERVAL_US;
        self.supervisor.add(supervisor);
        if let Some(learner) = learner {
            self.learner.add(learner);
            let bytes: u64 = shared_memory(&self.run_id).iter().map(|path| bytes(path)).sum();
            self.shm.0.push(bytes as f64);
        }
    }

    /// The larger of the supervisor's and the learner's ratio, since neither may grow.
    pub(super) fn ratios(&self) -> [(&'static str, Option<f64>); 4] {
        let larger = |of: fn(&Kind) -> &Series| {
            let both = [of(&self.supervisor).ratio(), of(&self.learner).ratio()];
            both.into_iter().flatten().reduce(f64::max)
        };
        [
            ("rss_ratio", larger(|kind| &kind.rss)),
            ("fds_ratio", larger(|kind| &kind.fds)),
            ("maps_ratio", larger(|kind| &kind.maps)),
            ("shm_ratio", self.shm.ratio()),
        ]
    }

    pub(super) fn summary(&self) -> Value {
        json!({ "supervisor": self.supervisor.summary(), "learner": self.learner.summary(),
                "shm_bytes": self.shm.summary() })
    }
}

/// Lists the shared memory of a run.
pub(super) fn shared_memory(run_id: &str) -> Vec<PathBuf> {
    let (folder, _) = Place::of_this_user().standard();
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let named = |path: &PathBuf| path.to_string_lossy().contains(run_id);
    entries.map(|entry| entry.path()).filter(named).collect()
}

/// Size of a folder in bytes. Files that disappear meanwhile do not count.
fn bytes(path: &Path) -> u64 {
    let Ok(metadata) = path.symlink_metadata() else { return 0 };
    if !metadata.is_dir() {
        return metadata.blocks() * 512;
    }
    let entries = fs::read_dir(path).into_iter().flatten().flatten();
    entries.map(|entry| bytes(&entry.path())).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_is_of_the_last_third_to_the_first() {
        let flat = Series(vec![5.0; 30]);
        assert_eq!(flat.ratio(), Some(1.0));
        let grown = Series((0..30).map(|n| if n < 15 { 10.0 } else { 11.0 }).collect());
        assert_eq!(grown.ratio(), Some(1.1));
        assert_eq!(Series(vec![1.0; SAMPLES_MIN - 1]).ratio(), None);
    }
}
