//! Everything a run needs to go on exactly: networks, targets, optimisers, replay, counters,
//! random states and how far each worker's segments had come, from one moment.
//!
//! ```text
//!   checkpoints/000012/   networks.safetensors · replay.bin · state.json
//!   checkpoints/latest -> 000012
//! ```
//! A checkpoint is written under a temporary name, synced and renamed, so a half-written one never
//! carries a number. `state.json` is written last and holds length and CRC-32 of the others: a
//! torn or damaged checkpoint is refused with the reason, and the one before it is used.

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

use crate::learner::{Counters, Learner};
use crate::normaliser::Normaliser;
use crate::replay::{Replay, ReplayFileError, Sampler};
use crate::update::adam::AdamStep;

pub use background::{Ended, Writer};
pub use rotation::names;

/// Version of this format.
const FORMAT_VERSION: u32 = 3;
const NETWORKS: &str = "networks.safetensors";
const REPLAY: &str = "replay.bin";
const STATE: &str = "state.json";

/// Why a checkpoint could not be written or was refused.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// Reading or writing failed.
    #[error("{path}: {cause}")]
    Io {
        /// File or directory.
        path: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// The checkpoint was written; the segment log could not be emptied.
    #[error("a checkpoint was written, but the segment log could not be emptied: {cause}")]
    Log {
        /// Why.
        cause: LogError,
    },
    /// What the device has learned could not be brought back.
    #[error("cannot bring the networks back from the device: {cause}")]
    Device {
        /// Why.
        cause: candle_core::Error,
    },
    /// A file whose length or checksum differs from what `state.json` says.
    #[error("{path}: {name} is {got}, expected {expected}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Length or checksum.
        name: &'static str,
        /// What `state.json` says.
        expected: u64,
        /// What the file has.
        got: u64,
    },
    /// A file that is not what its name says.
    #[error("{path}: {cause}")]
    Format {
        /// The file.
        path: PathBuf,
        /// Why.
        cause: String,
    },
    /// The replay does not fit.
    #[error("{path}: {cause}")]
    Replay {
        /// The file.
        path: PathBuf,
        /// Why.
        cause: ReplayFileError,
    },
    /// None of the checkpoints can be used.
    #[error("{path}: no usable checkpoint{refused}")]
    None {
        /// The folder.
        path: PathBuf,
        /// Why each was refused.
        refused: String,
    },
}

/// A small file's content: where the run stands.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    format_version: u32,
    architecture_hash: u64,
    counters: Counters,
    updates_owed: f64,
    /// By the network's name.
    adam_steps: BTreeMap<String, AdamStep>,
    sampler_random: Xoshiro256PlusPlus,
    /// Up to where segments are in the replay. Checkpoints of older versions have none.
    #[serde(default)]
    settled: Vec<Watermark>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    normaliser: Option<Normaliser>,
    files: Vec<FileSum>,
    /// CRC-32 of this state without this field. Formats 1 and 2 have none.
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

/// A checkpoint that was loaded, and the newer ones that had to be passed over.
#[derive(Debug)]
pub struct Loaded {
    /// Its directory's name.
    pub name: String,
    /// Why newer ones were refused.
    pub refused: Vec<CheckpointError>,
}

fn io_error(path: &Path) -> impl FnOnce(std::io::Error) -> CheckpointError + '_ {
    |cause| CheckpointError::Io { path: path.to_owned(), cause }
}

/// Everything that a checkpoint holds, from one moment: what training does afterwards does not
/// change it. It shares the replay's numbers with the learner, so it costs little more memory than
/// the networks do, and milliseconds.
#[derive(Debug)]
pub struct Cut {
    networks: Vec<u8>,
    replay: Replay,
    state: State,
    config: CheckpointConfig,
    /// What the segment log had of that moment [bytes]: forgotten once this is written.
    logged: u64,
}

impl Cut {
    /// Of this moment.
    ///
    /// # Errors
    /// If the networks cannot be brought back from the device.
    pub fn of(learner: &mut Learner) -> Result<Self, CheckpointError> {
        let fetched = learner.algorithm.fetch();
        fetched.map_err(|cause| CheckpointError::Device { cause })?;
        let networks = networks_file::bytes(learner)
            .map_err(|cause| CheckpointError::Format { path: NETWORKS.into(), cause })?;
        let steps = learner.networks().into_iter();
        let state = State {
            format_version: FORMAT_VERSION,
            architecture_hash: learner.policy().architecture_hash(),
            counters: learner.counters,
            updates_owed: learner.pacing.owed(),
            adam_steps: steps.map(|(name, t)| (name.to_owned(), t.adam.step)).collect(),
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

    /// Writes it into `folder` and drops the oldest there; returns its name.
    ///
    /// # Errors
    /// If writing fails; the checkpoints that were there are then untouched.
    pub fn write(self, folder: &Path) -> Result<String, CheckpointError> {
        let CheckpointConfig { keep, disk_bytes_max, .. } = self.config;
        rotation::remove_temporaries(folder)?;
        let name = rotation::next_name(folder)?;
        let temporary = folder.join(format!(".{name}.tmp"));
        fs::create_dir(&temporary).map_err(io_error(&temporary))?;
        if let Err(error) = self.write_files(&temporary) {
            // The disk may be full: the half-written one must not keep it so.
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

/// Where the run stood at each readable checkpoint of a folder, oldest first: where a resume may go
/// back to.
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

/// Counts and sums what passes through.
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

/// Loads the newest usable checkpoint of `folder` into a `learner` freshly made from the run's
/// configuration. One that is refused leaves no trace in `learner`'s successor: the caller makes
/// a fresh learner for every try through `fresh`.
///
/// # Errors
/// `None` if no checkpoint can be used, with the reason for each.
pub fn load_newest(
    folder: &Path,
    fresh: &dyn Fn() -> Result<Learner, crate::learner::LearnerError>,
) -> Result<(Learner, Loaded), CheckpointError> {
    let mut refused = Vec::new();
    for name in names(folder)?.into_iter().rev() {
        let path = folder.join(&name);
        let learner = fresh().map_err(|cause| CheckpointError::Format {
            path: path.clone(),
            cause: cause.to_string(),
        });
        match learner.and_then(|mut learner| load(&path, &mut learner).map(|()| learner)) {
            Ok(learner) => return Ok((learner, Loaded { name, refused })),
            Err(error) => refused.push(error),
        }
    }
    let refused: String = refused.iter().map(|error| format!("\n  {error}")).collect();
    Err(CheckpointError::None { path: folder.to_owned(), refused })
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
        let cause = format!("architecture {got:016x}, the configuration gives {own:016x}");
        return Err(format(&path, cause));
    }
    for name in [NETWORKS, REPLAY] {
        let sum = state.files.iter().find(|sum| sum.name == name);
        let sum = sum.ok_or_else(|| format(&path, format!("lists no {name}")))?;
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
    learner.each_network(|name, trained| match state.adam_steps.get(name) {
        Some(step) => {
            trained.adam.step = *step;
            Ok(())
        }
        None => Err(format(&path, format!("has no optimiser step of {name}"))),
    })?;
    if state.normaliser.as_ref().is_some_and(|normaliser| !normaliser.is_sound()) {
        return Err(format(&path, "observation normalisation contradicts itself".into()));
    }
    if state.normaliser.as_ref().map(Normaliser::observation_len)
        != learner.normaliser.as_ref().map(Normaliser::observation_len)
    {
        let cause = "observation normalisation differs from policy.normalise_observations";
        return Err(format(&path, cause.into()));
    }
    learner.normaliser = state.normaliser;
    learner.counters = state.counters;
    learner.inbox.restore(&state.settled);
    learner.pacing.restore(state.updates_owed);
    let windows = learner.config().algorithm.windows;
    learner.sampler = Sampler::new(windows, state.sampler_random);
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
