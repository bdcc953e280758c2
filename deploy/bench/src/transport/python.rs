//! Peers in Python: processes of `dmprl.bench_transport`, each of which starts its own sender.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use dmprl_run::Watch;
use serde::Deserialize;

use super::TransportBench;
use crate::child::LineChild;
use crate::synthetic_segments::Size;

/// Time limit until a peer is ready.
const READY: Duration = Duration::from_secs(120);
/// Time beyond a measurement's duration until it times out.
const MEASURE_SLACK: Duration = Duration::from_secs(30);

/// Names of the peers in `dmprl.bench_transport`.
pub(super) const NAMES: [&str; 2] = ["multiprocessing_queue", "zeromq"];

/// A peer's receiver process. Its child is the sender.
pub(super) struct PythonPeer {
    pub(super) name: &'static str,
    child: LineChild,
}

#[derive(Debug, Deserialize)]
struct Measured {
    segments: u64,
    seconds: f64,
}

impl PythonPeer {
    /// Starts the process without waiting for it.
    pub(super) fn start(
        name: &'static str,
        size: Size,
        bench: &TransportBench,
        folder: &Path,
    ) -> anyhow::Result<Self> {
        let label = format!("{name}-{}", size.bytes);
        let path = folder.join(format!("{label}.log"));
        let log = File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
        let mut command = Command::new(&bench.peer_python);
        command
            .args(["-m", "dmprl.bench_transport", name])
            .args(["--segment-bytes", &size.bytes.to_string()])
            .arg("--folder")
            .arg(folder)
            // `-m` puts the working directory first on the module path, so it must have none.
            .current_dir(folder)
            .env("PYTHONPATH", &bench.package_path)
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .stderr(log);
        Ok(Self { name, child: LineChild::start(label, command, &path)? })
    }

    /// Waits until the peer is ready. Returns its description, or the reason why it is unavailable.
    pub(super) fn ready(&mut self, watch: &Watch) -> anyhow::Result<Result<String, String>> {
        self.child.greeting(watch, READY)
    }

    /// Measures segments per second.
    pub(super) fn measure(&mut self, watch: &Watch, duration: Duration) -> anyhow::Result<f64> {
        self.child.send_line(&format!("run {}", duration.as_secs_f64()))?;
        let line = self.child.next_line(watch, duration + MEASURE_SLACK, "the measurement")?;
        let Ok(Measured { segments, seconds }) = serde_json::from_str(&line) else {
            return Err(self.child.unexpected_line(&line));
        };
        ensure!(seconds > 0.0, "{}: {segments} segments in {seconds} s", self.name);
        Ok(segments as f64 / seconds)
    }
}
