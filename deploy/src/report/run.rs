//! One run of a report, wherever it was read.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use dmprl_shared::config::PolicyKind;
use serde::{Deserialize, Serialize};

use super::moves::Moves;
use crate::control::EvaluationRow;
use crate::run_directory::{Machine, Manifest, Packages, Session};
use crate::terminal::binary_bytes;

/// Of a commit's hash, enough to find it.
const HASH_LEN: usize = 12;

/// One run and its evaluations.
#[derive(Debug, Clone)]
pub struct Run {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// What its method plans with.
    pub policy: PolicyKind,
    /// `run.seed`.
    pub seed: u64,
    /// Where it was read.
    pub source: Source,
    /// Whether it has come to its end.
    pub ended: bool,
    /// Environment steps that it was asked for.
    pub steps: u64,
    /// Who made it, where and when.
    pub origin: Origin,
    /// Oldest first.
    pub rows: Vec<EvaluationRow>,
    /// Episodes of its last evaluation; none where an older report does not say.
    pub final_episodes: Option<u64>,
    /// How its last policy moves, where that was measured.
    pub motion: Option<Moves>,
}

/// Where a run was read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// Its own directory.
    Directory(PathBuf),
    /// The folder of an earlier report: all that is left of it here.
    Report(PathBuf),
}

/// Which of the runs of a comparison.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Key {
    /// The task's name.
    pub task: String,
    /// The method's label.
    pub method: String,
    /// `run.seed`.
    pub seed: u64,
}

impl Display for Key {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} · {} · seed {}", self.task, self.method, self.seed)
    }
}

/// Who made a run, where and when.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// UTC, RFC 3339, of its first session.
    pub started: String,
    /// Versions of the program, with the commit where it is known; one a session.
    pub programs: Vec<String>,
    /// Versions of Python, MuJoCo, Gymnasium and NumPy; one a session that recorded them.
    #[serde(default)]
    pub packages: Vec<String>,
    /// SHA-256 of the resolved configuration of the last session that recorded it.
    #[serde(default)]
    pub config_sha256: Option<String>,
    /// Processor, cores and memory.
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
    /// The programs of its sessions; none if the sources of one are not known: no commit was
    /// recorded, or they differed from it.
    pub(super) fn known_programs(&self) -> Option<&[String]> {
        let is_known = |program: &String| {
            let commit = program.split_once("(commit ").map_or("", |(_, rest)| rest);
            let hash = commit.trim_end_matches(')');
            !hash.is_empty() && hash.chars().all(|letter| letter.is_ascii_hexdigit())
        };
        let all = !self.programs.is_empty() && self.programs.iter().all(is_known);
        all.then_some(self.programs.as_slice())
    }

    /// The packages of its sessions; none if one did not record them.
    pub(super) fn known_packages(&self) -> Option<&[String]> {
        let all = !self.packages.is_empty() && self.packages.len() == self.programs.len();
        all.then_some(self.packages.as_slice())
    }
}

/// `Python 3.11.7, MuJoCo 4.0.0, Gymnasium 1.4.0, NumPy 2.4.6, dmprl's Python package c4b5c29b`.
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
    /// The evaluation at its end; none while it has not come there.
    #[must_use]
    pub fn last(&self) -> Option<&EvaluationRow> {
        self.rows.last().filter(|_| self.ended)
    }

    /// Its directory; none of a landed run.
    #[must_use]
    pub fn directory(&self) -> Option<&Path> {
        match &self.source {
            Source::Directory(path) => Some(path),
            Source::Report(_) => None,
        }
    }

    /// Which it is.
    #[must_use]
    pub fn key(&self) -> Key {
        Key { task: self.task.clone(), method: self.method.clone(), seed: self.seed }
    }

    pub(super) fn is(&self, key: &Key) -> bool {
        (&self.task, &self.method, self.seed) == (&key.task, &key.method, key.seed)
    }
}
