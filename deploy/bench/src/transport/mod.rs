//! `dmprl bench transport`: compares the throughput of shared memory with that of other channels.
//!
//! The workers are processes of this program that only send (`worker`, `synthetic_segments`). The
//! receiver of `bench rollout` takes the learner's place: it checks, settles and acknowledges
//! (`shared_memory`). The peers are pipes and sockets between the same processes (`streams`) and
//! queues between Python processes (`python`). Each round runs every transport once, for the same
//! time, while the others sleep on a full channel; the report has the medians over the rounds
//! (`figures`). Finally, the benchmark measures the processor time of workers that are blocked.
//! `hosts` measures the transport between two hosts.

mod figures;
mod hosts;
mod python;
mod shared_memory;
mod streams;
mod worker;

use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_run::Manifest;
use dmprl_run::Progress;
use dmprl_run::{Interrupted, Watch};
use dmprl_shared::config::DeliveryLevel;

use crate::announce_round;

pub use figures::Figures;
pub use hosts::{connect, listen};
pub use worker::{TransportWorkerArgs, transport_worker};

use super::synthetic_segments::{SIZES, Size};
use figures::SHARED_MEMORY;
use python::PythonPeer;
use shared_memory::SharedMemory;
use streams::{StreamKind, StreamPeer};

/// Time in which the back-off of a blocked worker grows to its maximum.
const BLOCKED_SETTLE: Duration = Duration::from_millis(200);
/// Duration of the measurement of blocked workers.
const BLOCKED_DURATION: Duration = Duration::from_millis(1_500);
/// Interval between checks for an interrupt during that measurement.
const INTERRUPT_POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Settings of the benchmark.
pub struct TransportBench {
    /// Path of this program, which also runs the workers.
    pub program: PathBuf,
    /// Number of processes that send through shared memory. A peer has one.
    pub workers: u32,
    /// Delivery level, which determines when a worker may drop a segment from its outbox.
    pub level: DeliveryLevel,
    /// Interpreter of the Python peers.
    pub peer_python: PathBuf,
    /// Folder with the Python package.
    pub package_path: PathBuf,
    /// Number of rounds.
    pub rounds: usize,
    /// Duration of each measurement.
    pub duration: Duration,
}

/// Runs the benchmark; returns `None` if the user interrupted it. Removes all its processes and
/// files.
///
/// # Errors
/// A worker or a peer cannot be started or dies.
pub fn transport(
    bench: &TransportBench,
    progress: &dyn Progress,
) -> anyhow::Result<Option<Figures>> {
    match measure(bench, progress) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => result.map(Some),
    }
}

fn measure(bench: &TransportBench, progress: &dyn Progress) -> anyhow::Result<Figures> {
    let watch = Watch::start()?;
    let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
    let folder = folder.context("cannot make a folder for logs and sockets")?;
    let manifest = Manifest::new(None)?;
    let token = format!("{}-{}", &manifest.run_id[..8], std::process::id());
    progress.stage("starting workers and peers");
    let mut figures = Figures::new(bench, manifest.machine);
    // Started together, because importing Python packages takes most of the time.
    let mut pythons = Vec::new();
    for size in SIZES {
        for name in python::NAMES {
            match PythonPeer::start(name, size, bench, folder.path()) {
                Ok(peer) => pythons.push((size, peer)),
                // For example, `--peer-python` is not an executable.
                Err(error) => figures.note(name, &format!("{error:#}")),
            }
        }
    }
    let mut sizes = Vec::new();
    for (number, size) in SIZES.into_iter().enumerate() {
        let command = || {
            let mut command = Command::new(&bench.program);
            command.args(["transport-worker", "--segment-bytes", &size.bytes.to_string()]);
            command
        };
        let token = format!("{number}{token}");
        let shared_memory = SharedMemory::start(
            size,
            bench.workers,
            &token,
            &command,
            bench.level,
            folder.path(),
            &watch,
        )?;
        let start = |kind| StreamPeer::start(kind, size, command(), folder.path(), &watch);
        let streams = StreamKind::ALL.map(start).into_iter().collect::<anyhow::Result<Vec<_>>>()?;
        sizes.push(Transports { shared_memory, streams, pythons: Vec::new() });
    }
    for kind in StreamKind::ALL {
        figures.note(kind.name(), kind.about());
    }
    for (size, mut peer) in pythons {
        let ready = peer.ready(&watch)?;
        figures.note(peer.name, ready.as_ref().unwrap_or_else(|why| why));
        let transports =
            sizes.iter_mut().find(|transports| transports.shared_memory.size.bytes == size.bytes);
        if let (Ok(_), Some(transports)) = (ready, transports) {
            transports.pythons.push(peer);
        }
    }
    for round in 0..bench.rounds {
        announce_round(progress, round, bench.rounds);
        for transports in &mut sizes {
            transports.round(&watch, bench.duration, progress, &mut figures)?;
        }
    }
    progress.detail("blocked workers");
    figures.blocked_cpu_fraction = blocked(&sizes, &watch)?;
    for transports in sizes {
        let bytes = transports.shared_memory.size.bytes;
        figures.discrepancies.push((bytes, transports.shared_memory.finish(&watch)?));
    }
    Ok(figures)
}

/// All transports for segments of one size.
struct Transports {
    shared_memory: SharedMemory,
    streams: Vec<StreamPeer>,
    pythons: Vec<PythonPeer>,
}

impl Transports {
    fn round(
        &mut self,
        watch: &Watch,
        duration: Duration,
        progress: &dyn Progress,
        figures: &mut Figures,
    ) -> anyhow::Result<()> {
        let Size { bytes, .. } = self.shared_memory.size;
        for peer in &mut self.pythons {
            progress.detail(peer.name);
            figures.add(bytes, peer.name, peer.measure(watch, duration)?);
        }
        for peer in &mut self.streams {
            progress.detail(peer.kind.name());
            figures.add(bytes, peer.kind.name(), peer.measure(watch, duration)?);
        }
        progress.detail(SHARED_MEMORY);
        let window = self.shared_memory.measure(watch, duration)?;
        figures.add(bytes, SHARED_MEMORY, window.segments as f64 / window.seconds);
        figures.add_sink_share(bytes, window.cpu_s / window.seconds);
        Ok(())
    }
}

/// Measures the fraction of a core that the busiest worker uses while its queue and outbox are
/// full.
fn blocked(sizes: &[Transports], watch: &Watch) -> anyhow::Result<Option<f64>> {
    wait(watch, BLOCKED_SETTLE)?;
    let cpu_s = || -> Option<Vec<f64>> {
        let each: Option<Vec<_>> =
            sizes.iter().map(|transports| transports.shared_memory.cpu_s()).collect();
        each.map(|each| each.concat())
    };
    let (start, before) = (Instant::now(), cpu_s());
    wait(watch, BLOCKED_DURATION)?;
    let (seconds, after) = (start.elapsed().as_secs_f64(), cpu_s());
    let Some((before, after)) = before.zip(after) else { return Ok(None) };
    let shares = before.iter().zip(&after).map(|(before, after)| (after - before) / seconds);
    Ok(shares.reduce(f64::max))
}

fn wait(watch: &Watch, duration: Duration) -> anyhow::Result<()> {
    let end = Instant::now() + duration;
    while Instant::now() < end {
        watch.check()?;
        std::thread::sleep(INTERRUPT_POLL_INTERVAL);
    }
    Ok(())
}
