//! Samples the run's resources over time: memory, open files, memory maps, shared memory.

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

/// Values in the order of sampling: 14,400 in four hours.
#[derive(Debug, Clone, Default)]
struct Series(Vec<f64>);

impl Series {
    /// Median of the last third divided by the median of the first third.
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

/// Returns the median, or the upper of the two middle values. `None` if there are no values.
pub(super) fn median(numbers: &[f64]) -> Option<f64> {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

/// Samples of one process.
#[derive(Debug, Clone, Default)]
struct ProcessSamples {
    rss: Series,
    fds: Series,
    maps: Series,
}

impl ProcessSamples {
    fn add(&mut self, pid: Pid) {
        if let Some(resources) = holdings(pid) {
            self.rss.0.push(resources.rss_kib as f64);
            self.fds.0.push(resources.fds as f64);
            self.maps.0.push(resources.maps as f64);
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
    supervisor: ProcessSamples,
    learner: ProcessSamples,
    shm: Series,
}

impl Samples {
    pub(super) fn new(run_id: String) -> Self {
        let (supervisor, learner) = (ProcessSamples::default(), ProcessSamples::default());
        Self { run_id, next_us: 0, supervisor, learner, shm: Series::default() }
    }

    /// Returns true if the next sample is due.
    pub(super) fn is_due(&self, now_us: u64) -> bool {
        now_us >= self.next_us
    }

    /// Takes a sample of the supervisor, and of the learner and the shared memory if `learner` is
    /// given. It must only be given while the learner works and its replay is full.
    pub(super) fn take(&mut self, now_us: u64, supervisor: Pid, learner: Option<Pid>) {
        self.next_us = now_us + INTERVAL_US;
        self.supervisor.add(supervisor);
        if let Some(learner) = learner {
            self.learner.add(learner);
            let bytes: u64 = shared_memory(&self.run_id).iter().map(|path| bytes(path)).sum();
            self.shm.0.push(bytes as f64);
        }
    }

    /// Returns the growth of each resource: the larger of the supervisor's and the learner's ratio.
    pub(super) fn ratios(&self) -> [(&'static str, Option<f64>); 4] {
        let larger = |of: fn(&ProcessSamples) -> &Series| {
            let both = [of(&self.supervisor).ratio(), of(&self.learner).ratio()];
            both.into_iter().flatten().reduce(f64::max)
        };
        [
            ("rss_ratio", larger(|samples| &samples.rss)),
            ("fds_ratio", larger(|samples| &samples.fds)),
            ("maps_ratio", larger(|samples| &samples.maps)),
            ("shm_ratio", self.shm.ratio()),
        ]
    }

    pub(super) fn summary(&self) -> Value {
        json!({ "supervisor": self.supervisor.summary(), "learner": self.learner.summary(),
                "shm_bytes": self.shm.summary() })
    }
}

/// Lists the shared-memory folders of a run.
pub(super) fn shared_memory(run_id: &str) -> Vec<PathBuf> {
    let (folder, _) = Place::of_this_user().standard();
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let named = |path: &PathBuf| path.to_string_lossy().contains(run_id);
    entries.map(|entry| entry.path()).filter(named).collect()
}

/// Returns the size of a folder in bytes, without files that disappear meanwhile.
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
    fn ratio_compares_the_last_third_with_the_first() {
        let flat = Series(vec![5.0; 30]);
        assert_eq!(flat.ratio(), Some(1.0));
        let grown = Series((0..30).map(|n| if n < 15 { 10.0 } else { 11.0 }).collect());
        assert_eq!(grown.ratio(), Some(1.1));
        assert_eq!(Series(vec![1.0; SAMPLES_MIN - 1]).ratio(), None);
    }
}
