//! Caches the data of one run, and reads additions.

use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use dmprl_run::RunDirectory;
use dmprl_run::method_label;
use dmprl_run::tail::Tail;
use dmprl_shared::supervision::EvaluationRow;
use serde::Serialize;
use serde_json::Value;

use super::table::{Curve, Table};

/// A run whose supervisor is not on this machine counts as trained elsewhere if the dashboard has
/// seen its metrics grow within this time.
const GROWS_WITHIN: Duration = Duration::from_secs(60);
/// Time after which unused tables are dropped.
const TABLE_KEPT: Duration = Duration::from_secs(300);
/// Maximum number of points in a curve: no screen shows more side by side.
const POINTS_MAX: usize = 1_000;

/// Facts about a run, which change only with its files.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Facts {
    pub task: String,
    /// Name of the method in reports, such as `TD3-DMP`.
    pub method: String,
    pub algorithm: String,
    pub policy: String,
    pub seed: u64,
    /// Configured number of environment steps.
    pub steps: u64,
    /// Start of its first session, UTC in RFC 3339.
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

/// A file of rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rows {
    Metrics,
    Evaluations,
}

/// New points of curves.
#[derive(Debug, Serialize)]
pub struct Curves {
    /// Identifies the table to which `next` refers. If it changes, the client must fetch everything
    /// anew.
    pub table: u64,
    /// Row from which to request the next points.
    pub next: usize,
    /// Curves in the order requested.
    pub curves: Vec<Curve>,
}

#[derive(Debug)]
struct Growing {
    number: u64,
    tail: Tail,
    table: Table,
    asked: Instant,
}

/// Inode and length: a run's files are only appended to or replaced.
type Stamp = (u64, u64);

/// A run that the dashboard shows.
#[derive(Debug)]
pub struct Watched {
    pub directory: RunDirectory,
    pub facts: Facts,
    /// Reason for which its files cannot be used.
    pub fault: Option<String>,
    /// Last line of `metrics.jsonl`.
    pub last: Value,
    /// All evaluations, newest last.
    pub evaluations: Vec<EvaluationRow>,
    pub state: State,
    facts_stamp: [Stamp; 2],
    metrics_stamp: Stamp,
    evaluations_stamp: Stamp,
    grown: Option<Instant>,
    /// Process id of the supervisor that was last seen alive on this machine.
    seen_here: Option<u32>,
    tables: [Option<Growing>; 2],
}

impl Watched {
    /// Creates the cache without reading anything.
    pub fn new(directory: RunDirectory) -> Self {
        Self {
            directory,
            facts: Facts::default(),
            fault: None,
            last: Value::Null,
            evaluations: Vec::new(),
            state: State::Stopped,
            facts_stamp: [(0, 0); 2],
            metrics_stamp: (0, 0),
            evaluations_stamp: (0, 0),
            grown: None,
            seen_here: None,
            tables: [None, None],
        }
    }

    /// Reads the changed files. A run that cannot be read reports its fault and does not affect the
    /// others.
    pub fn refresh(&mut self) {
        self.fault = self.read_changes().err().map(|error| format!("{error:#}"));
        self.state = self.state_now();
        for table in &mut self.tables {
            if table.as_ref().is_some_and(|table| table.asked.elapsed() > TABLE_KEPT) {
                *table = None;
            }
        }
    }

    fn read_changes(&mut self) -> anyhow::Result<()> {
        let path = self.directory.path();
        let facts = ["config.toml", "manifest.json"].map(|name| stamp(&path.join(name)));
        if facts != self.facts_stamp {
            self.facts = read_facts(&self.directory)?;
            self.facts_stamp = facts;
        }
        let metrics = stamp(&self.directory.metrics_path());
        if metrics != self.metrics_stamp {
            self.last = self.directory.last_metrics()?.unwrap_or_default();
            // Rows present at the first look do not prove that the run is growing now.
            self.grown = (self.metrics_stamp != (0, 0)).then(Instant::now);
            self.metrics_stamp = metrics;
        }
        let evaluations = stamp(&self.directory.evaluations_path());
        if evaluations != self.evaluations_stamp {
            self.evaluations = self.directory.evaluations()?;
            self.evaluations_stamp = evaluations;
        }
        Ok(())
    }

    fn state_now(&mut self) -> State {
        let holder = self.directory.lock_holder();
        let here = self.directory.is_trained_here();
        if here {
            self.seen_here = holder;
        }
        let reached = self.evaluations.last().is_some_and(|row| {
            row.env_steps >= self.facts.steps
                || row.return_mean >= self.facts.until_return
                || row.success_rate.is_some_and(|rate| rate >= self.facts.until_success)
        });
        let grows = self.grown.is_some_and(|grown| grown.elapsed() < GROWS_WITHIN);
        // A supervisor that was seen here and is gone has died; the run is not trained elsewhere.
        let elsewhere = grows && holder != self.seen_here && self.has_not_ended();
        match (here, reached) {
            (true, _) => State::Training,
            (false, true) => State::Finished,
            (false, false) if elsewhere => State::Training,
            (false, false) => State::Stopped,
        }
    }

    /// Returns true unless the run's files say that its session has ended.
    fn has_not_ended(&self) -> bool {
        !matches!(self.directory.processes(), Ok(Some(processes)) if processes.ended)
    }

    /// Returns new points of curves, from row `from` of the table with number `table`.
    ///
    /// # Errors
    /// The file cannot be read, or a complete line is no JSON.
    pub fn curves(
        &mut self,
        rows: Rows,
        names: &[&str],
        (table, from): (u64, usize),
    ) -> anyhow::Result<Curves> {
        let path = match rows {
            Rows::Metrics => self.directory.metrics_path(),
            Rows::Evaluations => self.directory.evaluations_path(),
        };
        let growing = self.tables[rows as usize].get_or_insert_with(|| Growing::new(&path));
        growing.read_on(&path)?;
        growing.asked = Instant::now();
        let from = if table == growing.number { from } else { 0 };
        let curve = |name: &&str| growing.table.curve(name, from, POINTS_MAX);
        let curves = names.iter().map(curve).collect();
        Ok(Curves { table: growing.number, next: growing.table.rows(), curves })
    }
}

impl Growing {
    fn new(path: &Path) -> Self {
        Self {
            number: next_number(),
            tail: Tail::new(path),
            table: Table::default(),
            asked: Instant::now(),
        }
    }

    fn read_on(&mut self, path: &Path) -> anyhow::Result<()> {
        loop {
            let look = self.tail.look()?;
            if look.begun_again {
                (self.number, self.table) = (next_number(), Table::default());
            }
            for line in look.lines.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
                let row: Value = serde_json::from_slice(line).map_err(|error| {
                    anyhow::anyhow!("{}: a line is not JSON: {error}", path.display())
                })?;
                if self.table.push(&row) {
                    self.number = next_number();
                }
            }
            if !look.more {
                return Ok(());
            }
        }
    }
}

/// Returns a number that is unique within this process.
fn next_number() -> u64 {
    static NUMBER: AtomicU64 = AtomicU64::new(1);
    NUMBER.fetch_add(1, Ordering::Relaxed)
}

fn stamp(path: &Path) -> Stamp {
    std::fs::metadata(path).map_or((0, 0), |metadata| (metadata.ino(), metadata.len()))
}

fn read_facts(directory: &RunDirectory) -> anyhow::Result<Facts> {
    let (config, manifest) = (directory.config()?, directory.manifest()?);
    let name = |name: &dyn std::fmt::Debug| format!("{name:?}").to_lowercase();
    Ok(Facts {
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

    /// A resume removes the rows after its checkpoint. A page that kept those points would draw the
    /// curve twice.
    #[test]
    fn after_a_resume_has_cut_the_rows_a_curve_is_sent_anew() {
        let folder = tempfile::tempdir().unwrap();
        let directory = run(folder.path());
        let row =
            |steps: u32| format!("{{\"env_steps\":{steps},\"wall_s\":1.5,\"loss\":{steps}}}\n");
        let rows = |steps: &[u32]| steps.iter().map(|steps| row(*steps)).collect::<String>();
        fs::write(directory.metrics_path(), rows(&[1, 2, 3])).unwrap();
        let mut watched = Watched::new(directory.clone());
        let mut look = |since| watched.curves(Rows::Metrics, &["loss"], since).unwrap();
        let first = look((0, 0));
        assert_eq!(steps(&first), [1.0, 2.0, 3.0]);
        let since = (first.table, first.next);
        assert_eq!(steps(&look(since)), [0.0; 0]);
        directory.rewind(2).unwrap();
        let text = fs::read_to_string(directory.metrics_path()).unwrap();
        fs::write(directory.metrics_path(), text + &rows(&[4, 5, 6])).unwrap();
        let anew = look(since);
        assert_ne!(anew.table, first.table);
        assert_eq!(steps(&anew), [1.0, 2.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    fn a_run_that_cannot_be_read_says_so_until_it_can() {
        let folder = tempfile::tempdir().unwrap();
        let directory = run(folder.path());
        let mut watched = Watched::new(directory.clone());
        watched.refresh();
        assert_eq!((watched.fault.as_deref(), watched.state), (None, State::Stopped));
        let config = fs::read(directory.path().join("config.toml")).unwrap();
        fs::write(directory.path().join("config.toml"), "no TOML").unwrap();
        watched.refresh();
        assert!(watched.fault.as_ref().is_some_and(|fault| fault.contains("config.toml")));
        fs::write(directory.path().join("config.toml"), config).unwrap();
        watched.refresh();
        assert_eq!(watched.fault, None);
    }
}
