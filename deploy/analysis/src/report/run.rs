//! A run of a report, read from its directory or from an earlier report.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use dmprl_run::format::binary_bytes;
use dmprl_run::{Machine, Manifest, Packages, Session};
use dmprl_shared::config::PolicyKind;
use dmprl_shared::supervision::EvaluationRow;
use serde::{Deserialize, Serialize};

use super::motion_metrics::MotionMetrics;

/// Number of digits of a hash that are shown.
const HASH_LEN: usize = 12;

/// A run and its evaluations.
#[derive(Debug, Clone)]
pub struct Run {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// Kind of the policy.
    pub policy: PolicyKind,
    /// `run.seed`.
    pub seed: u64,
    /// Where it was read from.
    pub source: Source,
    /// Whether it is finished.
    pub ended: bool,
    /// Configured environment steps.
    pub steps: u64,
    /// Program, packages and machine of its sessions.
    pub origin: Origin,
    /// Evaluations, oldest first.
    pub rows: Vec<EvaluationRow>,
    /// Number of episodes in the last evaluation; `None` if an older report does not record it.
    pub final_episodes: Option<u64>,
    /// Motion of the latest policy, if it has been measured.
    pub motion: Option<MotionMetrics>,
}

/// Where a run was read from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// Its own directory.
    Directory(PathBuf),
    /// Folder of an earlier report. The run directory is not available.
    Report(PathBuf),
}

/// Identifies a run in a report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunKey {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// `run.seed`.
    pub seed: u64,
}

impl Display for RunKey {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} · {} · seed {}", self.task, self.method, self.seed)
    }
}

/// Programs, packages and machine of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// Start of the first session (UTC, RFC 3339).
    pub started: String,
    /// Program version of each session, with the commit if recorded.
    pub programs: Vec<String>,
    /// Versions of Python, MuJoCo, Gymnasium and NumPy in each session that recorded them.
    #[serde(default)]
    pub packages: Vec<String>,
    /// SHA-256 of the resolved configuration of the last session that recorded it.
    #[serde(default)]
    pub config_sha256: Option<String>,
    /// Processor, cores, memory and operating system.
    pub machine: String,
}

impl Origin {
    pub(super) fn of(manifest: &Manifest) -> Self {
        let program = |session: &Session| match &session.git_commit {
            Some(commit) => {
                let (hash, dirty) = commit.split_once('-').unwrap_or((commit, ""));
                let hash: String = hash.chars().take(HASH_LEN).collect();
                let dirty = if dirty.is_empty() { "" } else { " with changes" };
                format!("{} (commit {hash}{dirty})", session.dmprl_version)
            }
            None => session.dmprl_version.clone(),
        };
        let Machine { os, cpu, cores, memory_bytes } = &manifest.machine;
        let cpu = cpu.as_deref().unwrap_or("unknown processor");
        let memory = memory_bytes.map(|bytes| format!(", {}", binary_bytes(bytes)));
        Self {
            started: manifest
                .sessions
                .first()
                .map(|first| first.started.clone())
                .unwrap_or_default(),
            programs: manifest.sessions.iter().map(program).collect(),
            packages: manifest.sessions.iter().filter_map(packages).collect(),
            config_sha256: manifest
                .sessions
                .iter()
                .rev()
                .find_map(|session| session.config_sha256.clone()),
            machine: format!("{cpu}, {cores} cores{}, {os}", memory.unwrap_or_default()),
        }
    }
}

impl Origin {
    /// Returns the programs of the sessions; `None` if the sources of one are unknown because no
    /// commit was recorded or the sources had uncommitted changes.
    pub(super) fn known_programs(&self) -> Option<&[String]> {
        let is_known = |program: &String| {
            let commit = program.split_once("(commit ").map_or("", |(_, rest)| rest);
            let hash = commit.trim_end_matches(')');
            !hash.is_empty() && hash.chars().all(|letter| letter.is_ascii_hexdigit())
        };
        let all = !self.programs.is_empty() && self.programs.iter().all(is_known);
        all.then_some(self.programs.as_slice())
    }

    /// Returns the packages of the sessions; `None` if a session did not record them.
    pub(super) fn known_packages(&self) -> Option<&[String]> {
        let all = !self.packages.is_empty() && self.packages.len() == self.programs.len();
        all.then_some(self.packages.as_slice())
    }
}

/// Formats `Python 3.11.7, MuJoCo 4.0.0, Gymnasium 1.4.0, NumPy 2.4.6, dmprl's Python package
/// c4b5c29b`.
fn packages(session: &Session) -> Option<String> {
    let Packages { python, mujoco, gymnasium, numpy, dmprl_sha256 } = session.packages.as_ref()?;
    let version = |version: &Option<String>| version.clone().unwrap_or_else(|| "none".to_owned());
    let sources = version(dmprl_sha256);
    let sources: String = sources.chars().take(HASH_LEN).collect();
    Some(format!(
        "Python {python}, MuJoCo {}, Gymnasium {}, NumPy {}, dmprl's Python package {sources}",
        version(mujoco),
        version(gymnasium),
        version(numpy),
    ))
}

impl Run {
    /// Returns the last evaluation of a finished run; `None` while it is unfinished.
    #[must_use]
    pub fn last(&self) -> Option<&EvaluationRow> {
        self.rows.last().filter(|_| self.ended)
    }

    /// Returns the run directory; `None` if the run was read from an earlier report.
    #[must_use]
    pub fn directory(&self) -> Option<&Path> {
        match &self.source {
            Source::Directory(path) => Some(path),
            Source::Report(_) => None,
        }
    }

    /// Returns task, method and seed.
    #[must_use]
    pub fn key(&self) -> RunKey {
        RunKey { task: self.task.clone(), method: self.method.clone(), seed: self.seed }
    }

    /// Returns true if the run has this task, method and seed.
    pub(super) fn has_key(&self, key: &RunKey) -> bool {
        (&self.task, &self.method, self.seed) == (&key.task, &key.method, key.seed)
    }
}
