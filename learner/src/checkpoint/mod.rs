//! Writes and loads checkpoints: networks, targets, optimisers, replay, counters, random states and
//! the newest sequence number of each worker, all from one moment. A resumed run continues exactly.
//!
//! ```text
//!   checkpoints/000012/   networks.safetensors · replay.bin · state.json
//!   checkpoints/latest -> 000012
//! ```
//! A checkpoint is written under a temporary name, synced and renamed, so an incomplete one never
//! has a number. `state.json` is written last and has length and CRC-32 of the other files. A
//! damaged checkpoint is rejected with the reason, and the previous one is used.

mod background;
mod networks_file;
mod rotation;
mod state;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use dmprl_shared::config::CheckpointConfig;
use dmprl_shared::transport::delivery::{LogError, Watermark};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::finite::NotFiniteParameter;
use crate::learner::{Counters, Learner};
use crate::normaliser::Normaliser;
use crate::replay::{Replay, ReplayFileError};
use crate::update::adam::StepCount;

pub use background::{WriteOutcome, Writer};
pub use rotation::names;

/// Version of the format.
const FORMAT_VERSION: u32 = 3;
const NETWORKS: &str = "networks.safetensors";
const REPLAY: &str = "replay.bin";
const STATE: &str = "state.json";

/// Why a checkpoint could not be written or was rejected.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// Reading or writing failed.
    #[error("{path}: {cause}")]
    Io {
        /// File or directory.
        path: PathBuf,
        /// The reason.
        cause: std::io::Error,
    },
    /// The checkpoint was written, but the segment log could not be emptied.
    #[error("a checkpoint was written, but the segment log could not be emptied: {cause}")]
    Log {
        /// The reason.
        cause: LogError,
    },
    /// The networks could not be copied from the device.
    #[error("cannot copy the networks from the device: {cause}")]
    Device {
        /// The reason.
        cause: candle_core::Error,
    },
    /// A network that would be written is not finite.
    #[error("after update {updates}: {source}; the run has diverged, and no checkpoint is written")]
    NotFinite {
        /// Updates so far.
        updates: u64,
        /// The value.
        source: NotFiniteParameter,
    },
    /// The length or checksum of a file differs from `state.json`.
    #[error("{path}: {name} is {got}, expected {expected}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Length or checksum.
        name: &'static str,
        /// Value in `state.json`.
        expected: u64,
        /// Value of the file.
        got: u64,
    },
    /// A file has the wrong format.
    #[error("{path}: {cause}")]
    Format {
        /// The file.
        path: PathBuf,
        /// The reason.
        cause: String,
    },
    /// The replay file is unusable.
    #[error("{path}: {cause}")]
    Replay {
        /// The file.
        path: PathBuf,
        /// The reason.
        cause: ReplayFileError,
    },
    /// No checkpoint is usable.
    #[error("{path}: no usable checkpoint{rejected}")]
    None {
        /// The folder.
        path: PathBuf,
        /// The reason for each checkpoint, one per line.
        rejected: String,
    },
}

/// Contents of `state.json`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    format_version: u32,
    architecture_hash: u64,
    counters: Counters,
    updates_owed: f64,
    /// Optimiser steps by network name.
    adam_steps: BTreeMap<String, StepCount>,
    sampler_random: Xoshiro256PlusPlus,
    /// Marks up to which the replay has segments. Checkpoints of older versions do not have this
    /// field.
    #[serde(default)]
    settled: Vec<Watermark>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    normaliser: Option<Normaliser>,
    files: Vec<FileSum>,
    /// CRC-32 of the state without this field. Formats 1 and 2 do not have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    crc32: Option<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileSum {
    name: String,
    bytes: u64,
    crc32: u32,
}

/// A loaded checkpoint, with the newer ones that were rejected.
#[derive(Debug)]
pub struct Loaded {
    /// Name of the checkpoint's directory.
    pub name: String,
    /// Why newer checkpoints were rejected.
    pub rejected: Vec<CheckpointError>,
}

fn io_error(path: &Path) -> impl FnOnce(std::io::Error) -> CheckpointError + '_ {
    |cause| CheckpointError::Io { path: path.to_owned(), cause }
}

/// The contents of a checkpoint from one moment. Later training does not change them. They share
/// the replay's blocks with the learner, so capturing takes milliseconds and little more memory
/// than the networks.
#[derive(Debug)]
pub struct CheckpointContents {
    networks: Vec<u8>,
    replay: Replay,
    state: State,
    config: CheckpointConfig,
    /// Length of the segment log at that moment \[bytes\]. That part is removed once this is
    /// written.
    logged: u64,
}

impl CheckpointContents {
    /// Captures the learner's current state.
    ///
    /// # Errors
    /// If a network is not finite, or the networks cannot be copied from the device.
    pub fn capture(learner: &mut Learner) -> Result<Self, CheckpointError> {
        let fetched = learner.regime.fetch();
        fetched.map_err(|cause| CheckpointError::Device { cause })?;
        let updates = learner.counters.updates;
        networks_file::check_finite(learner)
            .map_err(|source| CheckpointError::NotFinite { updates, source })?;
        let networks = networks_file::bytes(learner)
            .map_err(|cause| CheckpointError::Format { path: NETWORKS.into(), cause })?;
        let steps = learner.networks().into_iter();
        let state = State {
            format_version: FORMAT_VERSION,
            architecture_hash: learner.policy().architecture_hash(),
            counters: learner.counters,
            updates_owed: learner.regime.updates_owed(),
            adam_steps: steps.map(|(name, network)| (name.to_owned(), network.adam.step)).collect(),
            sampler_random: learner.sampler.random().clone(),
            settled: learner.inbox.settled().to_vec(),
            normaliser: learner.normaliser.clone(),
            files: Vec::new(),
            crc32: None,
        };
        Ok(Self {
            networks,
            replay: learner.replay.clone(),
            state,
            config: learner.config().checkpoint.clone(),
            logged: learner.inbox.logged(),
        })
    }

    /// Writes the checkpoint into `folder` and deletes the oldest ones. Returns its name.
    ///
    /// # Errors
    /// If writing fails. Existing checkpoints are then unchanged.
    pub fn write(self, folder: &Path) -> Result<String, CheckpointError> {
        let CheckpointConfig { keep, disk_bytes_max, .. } = self.config;
        rotation::remove_temporaries(folder)?;
        let name = rotation::next_name(folder)?;
        let temporary = folder.join(format!(".{name}.tmp"));
        fs::create_dir(&temporary).map_err(io_error(&temporary))?;
        if let Err(error) = self.write_files(&temporary) {
            // The disk may be full, so the incomplete checkpoint must not stay.
            let _ = fs::remove_dir_all(&temporary);
            return Err(error);
        }
        let path = folder.join(&name);
        fs::rename(&temporary, &path).map_err(io_error(&path))?;
        rotation::point_latest(folder, &name)?;
        rotation::rotate(folder, keep, disk_bytes_max)?;
        Ok(name)
    }

    fn write_files(mut self, folder: &Path) -> Result<(), CheckpointError> {
        let networks = write_summed(folder, NETWORKS, |out| out.write_all(&self.networks))?;
        let replay = write_summed(folder, REPLAY, |out| {
            self.replay.write(out).map_err(std::io::Error::other)
        })?;
        self.state.files = vec![networks, replay];
        let path = folder.join(STATE);
        let sum = state::sum(&mut self.state);
        self.state.crc32 =
            Some(sum.map_err(|cause| CheckpointError::Format { path, cause: cause.to_string() })?);
        write_summed(folder, STATE, |out| {
            serde_json::to_writer_pretty(out, &self.state).map_err(Into::into)
        })?;
        File::open(folder).and_then(|dir| dir.sync_all()).map_err(io_error(folder))
    }
}

/// Returns the counters of each readable checkpoint in a folder, oldest first. A resume may go back
/// to any of them.
///
/// # Errors
/// If the folder cannot be read.
pub fn counters(folder: &Path) -> Result<Vec<Counters>, CheckpointError> {
    let read = |name: String| {
        let state = state::read(&fs::read(folder.join(name).join(STATE)).ok()?).ok()?;
        Some(state.counters)
    };
    Ok(names(folder)?.into_iter().filter_map(read).collect())
}

/// A writer that counts bytes and computes their CRC-32.
struct Summing<W> {
    inner: W,
    bytes: u64,
    crc: crc32fast::Hasher,
}

impl<W: Write> Write for Summing<W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.crc.update(&bytes[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.inner.flush()
    }
}

fn write_summed(
    folder: &Path,
    name: &str,
    write: impl FnOnce(&mut Summing<BufWriter<File>>) -> std::io::Result<()>,
) -> Result<FileSum, CheckpointError> {
    let path = folder.join(name);
    let run = || {
        let inner = BufWriter::with_capacity(1 << 20, File::create_new(&path)?);
        let mut out = Summing { inner, bytes: 0, crc: crc32fast::Hasher::new() };
        write(&mut out)?;
        out.flush()?;
        out.inner.get_ref().sync_all()?;
        Ok(FileSum { name: name.to_owned(), bytes: out.bytes, crc32: out.crc.finalize() })
    };
    run().map_err(io_error(&path))
}

/// Loads the newest usable checkpoint of `folder` into a learner made by `fresh`. Each attempt uses
/// another learner, so that a rejected checkpoint has no effect.
///
/// # Errors
/// [`CheckpointError::None`] if no checkpoint is usable, with the reason for each.
pub fn load_newest(
    folder: &Path,
    fresh: &dyn Fn() -> Result<Learner, crate::learner::LearnerError>,
) -> Result<(Learner, Loaded), CheckpointError> {
    let mut rejected = Vec::new();
    for name in names(folder)?.into_iter().rev() {
        let path = folder.join(&name);
        let learner = fresh().map_err(|cause| CheckpointError::Format {
            path: path.clone(),
            cause: cause.to_string(),
        });
        match learner.and_then(|mut learner| load(&path, &mut learner).map(|()| learner)) {
            Ok(learner) => return Ok((learner, Loaded { name, rejected })),
            Err(error) => rejected.push(error),
        }
    }
    let rejected: String = rejected.iter().map(|error| format!("\n  {error}")).collect();
    Err(CheckpointError::None { path: folder.to_owned(), rejected })
}

fn load(folder: &Path, learner: &mut Learner) -> Result<(), CheckpointError> {
    let path = folder.join(STATE);
    let format =
        |path: &Path, cause: String| CheckpointError::Format { path: path.to_owned(), cause };
    let text = fs::read(&path).map_err(io_error(&path))?;
    let state = state::read(&text).map_err(|cause| format(&path, cause))?;
    let own = learner.policy().architecture_hash();
    if state.architecture_hash != own {
        let got = state.architecture_hash;
        let cause = format!(
            "architecture is {got:016x}, expected {own:016x} from the configuration: \
             task.id, task.kwargs, task.wrappers, policy and dmp must be as before"
        );
        return Err(format(&path, cause));
    }
    for name in [NETWORKS, REPLAY] {
        let sum = state.files.iter().find(|sum| sum.name == name);
        let sum = sum.ok_or_else(|| format(&path, format!("does not list {name}")))?;
        verify(&folder.join(name), sum)?;
    }
    let networks = folder.join(NETWORKS);
    let bytes = fs::read(&networks).map_err(io_error(&networks))?;
    networks_file::restore(&bytes, learner).map_err(|cause| format(&networks, cause))?;
    let replay = folder.join(REPLAY);
    let mut input =
        BufReader::with_capacity(1 << 20, File::open(&replay).map_err(io_error(&replay))?);
    learner
        .replay
        .read(&mut input)
        .map_err(|cause| CheckpointError::Replay { path: replay, cause })?;
    learner.for_each_network(|name, network| match state.adam_steps.get(name) {
        Some(step) => {
            network.adam.step = *step;
            Ok(())
        }
        None => Err(format(&path, format!("has no optimiser steps of {name}"))),
    })?;
    if state.normaliser.as_ref().is_some_and(|normaliser| !normaliser.is_valid()) {
        return Err(format(
            &path,
            "the statistics of the observation normalisation are invalid".into(),
        ));
    }
    if state.normaliser.as_ref().map(Normaliser::observation_len)
        != learner.normaliser.as_ref().map(Normaliser::observation_len)
    {
        let cause = "observation normalisation does not match policy.normalise_observations";
        return Err(format(&path, cause.into()));
    }
    learner.normaliser = state.normaliser;
    learner.counters = state.counters;
    learner.inbox.restore(&state.settled);
    learner.regime.restore_updates_owed(state.updates_owed);
    learner.sampler.restore(state.sampler_random);
    Ok(())
}

fn verify(path: &Path, sum: &FileSum) -> Result<(), CheckpointError> {
    let damaged = |name, expected, got| CheckpointError::Damaged {
        path: path.to_owned(),
        name,
        expected,
        got,
    };
    let mut file = File::open(path).map_err(io_error(path))?;
    let len = file.metadata().map_err(io_error(path))?.len();
    if len != sum.bytes {
        return Err(damaged("length in bytes", sum.bytes, len));
    }
    let mut crc = crc32fast::Hasher::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(io_error(path))? {
            0 => break,
            read => crc.update(&buffer[..read]),
        }
    }
    match crc.finalize() {
        got if got == sum.crc32 => Ok(()),
        got => Err(damaged("CRC-32", sum.crc32.into(), got.into())),
    }
}

#[cfg(test)]
mod tests;
