//! Caches the data of one run, and reads what is appended to its files.

use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use dmprl_run::method_label;
use dmprl_run::tail::Tail;
use dmprl_run::{Holder, RunDirectory};
use dmprl_shared::supervision::EvaluationRow;
use serde::Serialize;
use serde_json::Value;

use super::table::{Curve, Table};

/// A run whose supervisor is not on this machine counts as training on another one if its metrics
/// have grown within this time.
const GROWTH_TIMEOUT: Duration = Duration::from_secs(60);
/// Time after the last request at which a table is dropped.
const TABLE_IDLE_MAX: Duration = Duration::from_secs(300);
/// Maximum number of points of a curve in a response: more than a chart has pixels in width.
const POINTS_MAX: usize = 1_000;

/// Description of a run, from its configuration and manifest.
#[derive(Debug, Clone, Default, Serialize)]
pub struct RunInfo {
    pub task: String,
    /// Name of the method in reports, such as `TD3-DMP`.
    pub method: String,
    pub algorithm: String,
    pub policy: String,
    pub seed: u64,
    /// Configured number of environment steps.
    pub steps: u64,
    /// Start of the run's first session, UTC in RFC 3339.
    pub started: String,
    until_return: f64,
    until_success: f64,
}

/// State of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    Training,
    Finished,
    Stopped,
}

/// A file with one JSON object per line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rows {
    Metrics,
    Evaluations,
}

/// A row of a table.
#[derive(Debug, Clone, Copy)]
pub struct TablePosition {
    /// Id of the table; 0 for none.
    pub table: u64,
    /// Index of the row.
    pub row: usize,
}

/// New points of curves.
#[derive(Debug, Serialize)]
pub struct Curves {
    /// Id of the table to which `next` refers. If it differs from the requested one, `curves` have
    /// all points and replace those of the client.
    pub table: u64,
    /// Row from which to request the next points.
    pub next: usize,
    /// Curves in the order requested.
    pub curves: Vec<Curve>,
}

/// Table of a file that is appended to.
#[derive(Debug)]
struct GrowingTable {
    /// Changes whenever rows are dropped or renumbered.
    id: u64,
    tail: Tail,
    table: Table,
    last_request: Instant,
}

/// Identifies the content of a file that is only appended to or replaced.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct FileStamp {
    inode: u64,
    bytes: u64,
}

impl FileStamp {
    /// Returns the stamp of a file; the default if it does not exist.
    fn of(path: &Path) -> Self {
        std::fs::metadata(path).map_or_else(
            |_| Self::default(),
            |metadata| Self { inode: metadata.ino(), bytes: metadata.len() },
        )
    }
}

/// A run that the dashboard shows.
#[derive(Debug)]
pub struct CachedRun {
    pub directory: RunDirectory,
    pub info: RunInfo,
    /// Why its files cannot be read; `None` if they can.
    pub fault: Option<String>,
    /// Last line of `metrics.jsonl`; null without one.
    pub last_metrics: Value,
    /// All evaluations, newest last.
    pub evaluations: Vec<EvaluationRow>,
    pub state: State,
    info_stamps: [FileStamp; 2],
    metrics_stamp: FileStamp,
    evaluations_stamp: FileStamp,
    /// Time at which the metrics were last seen to grow.
    last_growth: Option<Instant>,
    /// The supervisor last seen alive on this machine.
    local_supervisor: Option<Holder>,
    tables: [Option<GrowingTable>; 2],
}

impl CachedRun {
    /// Creates the cache without reading anything.
    pub fn new(directory: RunDirectory) -> Self {
        Self {
            directory,
            info: RunInfo::default(),
            fault: None,
            last_metrics: Value::Null,
            evaluations: Vec::new(),
            state: State::Stopped,
            info_stamps: [FileStamp::default(); 2],
            metrics_stamp: FileStamp::default(),
            evaluations_stamp: FileStamp::default(),
            last_growth: None,
            local_supervisor: None,
            tables: [None, None],
        }
    }

    /// Reads the changed files. If that fails, `fault` has the reason; other runs are unaffected.
    pub fn refresh(&mut self) {
        self.fault = self.read_changes().err().map(|error| format!("{error:#}"));
        self.state = self.current_state();
        for table in &mut self.tables {
            if table.as_ref().is_some_and(|table| table.last_request.elapsed() > TABLE_IDLE_MAX) {
                *table = None;
            }
        }
    }

    fn read_changes(&mut self) -> anyhow::Result<()> {
        let path = self.directory.path();
        let info = ["config.toml", "manifest.json"].map(|name| FileStamp::of(&path.join(name)));
        if info != self.info_stamps {
            self.info = read_info(&self.directory)?;
            self.info_stamps = info;
        }
        let metrics = FileStamp::of(&self.directory.metrics_path());
        if metrics != self.metrics_stamp {
            self.last_metrics = self.directory.last_metrics()?.unwrap_or_default();
            // Rows that were there at the first read do not show that the run is growing now.
            let is_first = self.metrics_stamp == FileStamp::default();
            self.last_growth = (!is_first).then(Instant::now);
            self.metrics_stamp = metrics;
        }
        let evaluations = FileStamp::of(&self.directory.evaluations_path());
        if evaluations != self.evaluations_stamp {
            self.evaluations = self.directory.evaluations()?;
            self.evaluations_stamp = evaluations;
        }
        Ok(())
    }

    fn current_state(&mut self) -> State {
        let holder = self.directory.lock_holder();
        let here = self.directory.is_trained_here();
        if here {
            self.local_supervisor.clone_from(&holder);
        }
        let reached = self.evaluations.last().is_some_and(|row| {
            row.env_steps >= self.info.steps
                || row.return_mean >= self.info.until_return
                || row.success_rate.is_some_and(|rate| rate >= self.info.until_success)
        });
        let grows = self.last_growth.is_some_and(|grown| grown.elapsed() < GROWTH_TIMEOUT);
        // If the last supervisor ran on this machine and is gone, it died: the run is not training
        // elsewhere.
        let died = holder.as_ref().is_some_and(Holder::is_on_this_machine)
            || holder == self.local_supervisor;
        let elsewhere = grows && !died && self.may_be_running();
        match (here, reached) {
            (true, _) => State::Training,
            (false, true) => State::Finished,
            (false, false) if elsewhere => State::Training,
            (false, false) => State::Stopped,
        }
    }

    /// Returns false if the run's files say that its session has ended.
    fn may_be_running(&self) -> bool {
        !matches!(self.directory.processes(), Ok(Some(processes)) if processes.ended)
    }

    /// Returns the points of curves from a position on, or all points if the table has changed
    /// since.
    ///
    /// # Errors
    /// The file cannot be read, or a complete line is not JSON.
    pub fn curves(
        &mut self,
        rows: Rows,
        names: &[&str],
        from: TablePosition,
    ) -> anyhow::Result<Curves> {
        let path = match rows {
            Rows::Metrics => self.directory.metrics_path(),
            Rows::Evaluations => self.directory.evaluations_path(),
        };
        let growing = self.tables[rows as usize].get_or_insert_with(|| GrowingTable::new(&path));
        growing.update(&path)?;
        growing.last_request = Instant::now();
        let row = if from.table == growing.id { from.row } else { 0 };
        let curve = |name: &&str| growing.table.curve(name, row, POINTS_MAX);
        let curves = names.iter().map(curve).collect();
        Ok(Curves { table: growing.id, next: growing.table.rows(), curves })
    }
}

impl GrowingTable {
    fn new(path: &Path) -> Self {
        Self {
            id: next_id(),
            tail: Tail::new(path),
            table: Table::default(),
            last_request: Instant::now(),
        }
    }

    /// Reads the lines appended since the last call.
    fn update(&mut self, path: &Path) -> anyhow::Result<()> {
        loop {
            let look = self.tail.look()?;
            if look.begun_again {
                (self.id, self.table) = (next_id(), Table::default());
            }
            for line in look.lines.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
                let row: Value = serde_json::from_slice(line).map_err(|error| {
                    anyhow::anyhow!("{}: a line is not JSON: {error}", path.display())
                })?;
                if self.table.push(&row) {
                    self.id = next_id();
                }
            }
            if !look.more {
                return Ok(());
            }
        }
    }
}

/// Returns an id that is unique within this process.
fn next_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

fn read_info(directory: &RunDirectory) -> anyhow::Result<RunInfo> {
    let (config, manifest) = (directory.config()?, directory.manifest()?);
    let name = |name: &dyn std::fmt::Debug| format!("{name:?}").to_lowercase();
    Ok(RunInfo {
        method: method_label(&config, manifest.preset()),
        algorithm: name(&config.algorithm.name),
        policy: name(&config.policy.kind),
        seed: config.run.seed,
        steps: config.run.steps,
        started: manifest.sessions.first().map(|first| first.started.clone()).unwrap_or_default(),
        until_return: config.run.until_return,
        until_success: config.run.until_success,
        task: config.task.name,
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use dmprl_run::Manifest;

    fn run(folder: &Path) -> RunDirectory {
        let manifest = Manifest::new(None).unwrap();
        RunDirectory::create(&folder.join("run"), &Default::default(), &manifest).unwrap()
    }

    fn steps(curves: &Curves) -> &[f64] {
        &curves.curves[0].env_steps
    }

    /// A resume removes the rows after its checkpoint. If the page kept those points, it would draw
    /// that part of the curve twice.
    #[test]
    fn whole_curve_is_sent_again_after_a_resume() {
        let folder = tempfile::tempdir().unwrap();
        let directory = run(folder.path());
        let row =
            |steps: u32| format!("{{\"env_steps\":{steps},\"wall_s\":1.5,\"loss\":{steps}}}\n");
        let rows = |steps: &[u32]| steps.iter().map(|steps| row(*steps)).collect::<String>();
        fs::write(directory.metrics_path(), rows(&[1, 2, 3])).unwrap();
        let mut cached = CachedRun::new(directory.clone());
        let mut curves = |from| cached.curves(Rows::Metrics, &["loss"], from).unwrap();
        let first = curves(TablePosition { table: 0, row: 0 });
        assert_eq!(steps(&first), [1.0, 2.0, 3.0]);
        let end = TablePosition { table: first.table, row: first.next };
        assert_eq!(steps(&curves(end)), [0.0; 0]);
        directory.rewind(2).unwrap();
        let text = fs::read_to_string(directory.metrics_path()).unwrap();
        fs::write(directory.metrics_path(), text + &rows(&[4, 5, 6])).unwrap();
        let again = curves(end);
        assert_ne!(again.table, first.table);
        assert_eq!(steps(&again), [1.0, 2.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    fn unreadable_run_reports_a_fault_until_it_is_repaired() {
        let folder = tempfile::tempdir().unwrap();
        let directory = run(folder.path());
        let mut cached = CachedRun::new(directory.clone());
        cached.refresh();
        assert_eq!((cached.fault.as_deref(), cached.state), (None, State::Stopped));
        let config = fs::read(directory.path().join("config.toml")).unwrap();
        fs::write(directory.path().join("config.toml"), "no TOML").unwrap();
        cached.refresh();
        assert!(cached.fault.as_ref().is_some_and(|fault| fault.contains("config.toml")));
        fs::write(directory.path().join("config.toml"), config).unwrap();
        cached.refresh();
        assert_eq!(cached.fault, None);
    }
}
