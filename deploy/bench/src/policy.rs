//! `dmprl bench policy`: compares the latency of a decision with other runtimes.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::Context;
use dmprl_analysis::export;
use dmprl_run::{Interrupted, Watch};
use dmprl_runtime::PolicyRuntime;
use dmprl_shared::policy_file::OpenedPolicy;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::child::LineChild;

/// Time limit for a peer to import its runtime on a busy machine.
const GREETING: Duration = Duration::from_secs(60);
/// Time limit of a peer's round.
const ROUND: Duration = Duration::from_secs(60);
/// Calls before the first round, to warm up caches, clock frequency and pages.
const WARM_UP: usize = 500;
/// Number of different observations to cycle through.
const OBSERVATIONS: usize = 256;
/// Goal for the 99th percentile of a decision: a tenth of a control period at 1 kHz.
pub const GOAL_US: f64 = 100.0;

/// Settings of the benchmark.
pub struct PolicyBench {
    /// Policy to measure.
    pub opened: OpenedPolicy,
    /// Python interpreter with NumPy, and onnxruntime for the ONNX peer.
    pub python: PathBuf,
    /// Folder with the package `dmprl`.
    pub package_path: PathBuf,
    /// Number of rounds.
    pub rounds: usize,
    /// Calls per round.
    pub calls: usize,
}

/// Latency of a call in microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Latency {
    /// Median.
    pub p50_us: f64,
    /// 99th percentile.
    pub p99_us: f64,
    /// Maximum.
    pub max_us: f64,
}

impl Latency {
    /// Computes the quantiles. Returns `None` if there were no calls.
    fn of(mut us: Vec<f64>) -> Option<Self> {
        us.sort_by(f64::total_cmp);
        let at = |share: f64| us.get(((us.len() as f64 * share).ceil() as usize).max(1) - 1);
        Some(Self { p50_us: *at(0.5)?, p99_us: *at(0.99)?, max_us: *us.last()? })
    }

    fn text(&self) -> String {
        format!(
            "p50 {:>8.1} µs   p99 {:>8.1} µs   max {:>8.1} µs",
            self.p50_us, self.p99_us, self.max_us
        )
    }
}

/// A peer's name and latency, or the reason why it is unavailable.
pub type Peer = Result<(String, Latency), String>;

/// Report of the benchmark.
#[derive(Debug)]
pub struct PolicyFigures {
    /// Environment and network widths.
    pub what: String,
    /// Number of policy parameters.
    pub parameters: usize,
    /// Latency from an observation to a segment.
    pub decision: Latency,
    /// Latency of a control step, decisions included.
    pub action: Latency,
    /// (runtime, its result).
    pub peers: Vec<(&'static str, Peer)>,
}

impl PolicyFigures {
    /// Returns the figures as one JSON object.
    #[must_use]
    pub fn json(&self) -> serde_json::Value {
        let peers = self.peers.iter().map(|(kind, found)| {
            let found = match found {
                Ok((name, latency)) => json!({ "name": name, "decision": latency }),
                Err(_) => serde_json::Value::Null,
            };
            ((*kind).to_owned(), found)
        });
        json!({
            "what": self.what, "parameters": self.parameters, "goal_p99_us": GOAL_US,
            "decision": self.decision, "action": self.action,
            "peers": peers.collect::<serde_json::Map<_, _>>(),
        })
    }

    /// Returns the figures as text.
    #[must_use]
    pub fn text(&self) -> String {
        let mut lines = vec![format!("{}, {} parameters, one core", self.what, self.parameters)];
        lines.push(format!("decision     {}", self.decision.text()));
        lines.push(format!("action       {}", self.action.text()));
        for (kind, found) in &self.peers {
            lines.push(match found {
                Ok((name, latency)) => {
                    let times = latency.p50_us / self.decision.p50_us;
                    format!("{kind:<12} {}   {times:.1} × our time ({name})", latency.text())
                }
                Err(why) => format!("{kind:<12} unavailable: {why}"),
            });
        }
        let met = if self.decision.p99_us < GOAL_US { "met" } else { "missed" };
        lines.push(format!("goal         p99 of a decision below {GOAL_US} µs: {met}"));
        lines.join("\n")
    }
}

/// Runs the benchmark; returns `None` if the user interrupted it.
///
/// # Errors
/// A peer dies or sends an invalid answer, or the file system fails.
pub fn policy(bench: &PolicyBench) -> anyhow::Result<Option<PolicyFigures>> {
    let watch = Watch::start()?;
    match measure(bench, &watch) {
        Err(error) if error.is::<Interrupted>() => Ok(None),
        result => result.map(Some),
    }
}

fn measure(bench: &PolicyBench, watch: &Watch) -> anyhow::Result<PolicyFigures> {
    let folder = tempfile::tempdir().context("cannot make a folder for the policy")?;
    let files = [
        ("numpy", folder.path().join("policy.safetensors")),
        ("onnx", folder.path().join("policy.onnx")),
    ];
    let exported = [export::safetensors(&bench.opened)?, export::onnx(&bench.opened)?];
    for ((_, file), bytes) in files.iter().zip(exported) {
        std::fs::write(file, bytes).context("cannot write the policy")?;
    }
    let mut peers = Vec::new();
    for (kind, file) in &files {
        let mut child = start(bench, kind, file, folder.path())?;
        let greeting = child.greeting(watch, GREETING)?;
        peers.push((*kind, greeting.map(|name| (name, child)), Vec::new()));
    }
    let mut ours = OwnRuntime::load(&files[0].1)?;
    ours.calls(WARM_UP, Call::Decision)?;
    let (mut decisions, mut actions) = (Vec::new(), Vec::new());
    for _ in 0..bench.rounds {
        watch.check()?;
        decisions.extend(ours.calls(bench.calls, Call::Decision)?);
        actions.extend(ours.calls(bench.calls, Call::Action)?);
        for (_, child, us) in &mut peers {
            if let Ok((_, child)) = child {
                us.extend(round(child, watch, bench.calls)?);
            }
        }
    }
    let none = || anyhow::anyhow!("nothing was measured");
    let peers = peers.into_iter().map(|(kind, child, us)| {
        let found = child.and_then(|(name, _)| {
            Latency::of(us).map(|latency| (name, latency)).ok_or_else(|| "no calls".to_owned())
        });
        (kind, found)
    });
    let shape = bench.opened.policy.shape();
    let widths = std::iter::once(shape.inputs());
    let widths = widths.chain(shape.layers().iter().map(|layer| layer.outputs));
    let widths: Vec<_> = widths.map(|width| width.to_string()).collect();
    Ok(PolicyFigures {
        what: format!("{} {}", ours.runtime.spec().id, widths.join("-")),
        parameters: bench.opened.policy.parameters_len(),
        decision: Latency::of(decisions).ok_or_else(none)?,
        action: Latency::of(actions).ok_or_else(none)?,
        peers: peers.collect(),
    })
}

fn start(bench: &PolicyBench, kind: &str, file: &Path, folder: &Path) -> anyhow::Result<LineChild> {
    let log = folder.join(format!("{kind}.log"));
    let stderr = std::fs::File::create(&log).context("cannot make a log")?;
    let mut command = Command::new(&bench.python);
    command.args(["-m", "dmprl.bench_policy", kind]).arg(file).stderr(stderr);
    // `-m` puts the working directory first on the module path, so it must have no modules.
    command.current_dir(folder);
    command.env("PYTHONPATH", &bench.package_path).env("PYTHONDONTWRITEBYTECODE", "1");
    // One core, like our own runtime.
    command.envs(["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"].map(|name| (name, "1")));
    LineChild::start(format!("the policy in {kind}"), command, &log)
}

fn round(child: &mut LineChild, watch: &Watch, calls: usize) -> anyhow::Result<Vec<f64>> {
    #[derive(Deserialize)]
    struct Round {
        us: Vec<f64>,
    }
    child.send_line(&format!("run {calls}"))?;
    let line = child.next_line(watch, ROUND, "a round")?;
    let round: Round = serde_json::from_str(&line).map_err(|_| child.unexpected_line(&line))?;
    Ok(round.us)
}

#[derive(Clone, Copy)]
enum Call {
    Decision,
    Action,
}

/// The runtime of this project, with the observations for its calls.
struct OwnRuntime {
    runtime: PolicyRuntime,
    observations: Vec<Vec<f64>>,
}

impl OwnRuntime {
    fn load(file: &Path) -> anyhow::Result<Self> {
        let runtime = PolicyRuntime::load(file)?;
        let len = runtime.spec().observation_len;
        let row = |row: usize| (0..len).map(|i| ((row * len + i) as f64 * 1.7).sin()).collect();
        let observations = (0..OBSERVATIONS).map(row).collect();
        Ok(Self { runtime, observations })
    }

    /// Returns the time of each of `count` calls in microseconds.
    fn calls(&mut self, count: usize, call: Call) -> anyhow::Result<Vec<f64>> {
        let Self { runtime, observations } = self;
        let mut took = Vec::with_capacity(count);
        for row in observations.iter().cycle().take(count) {
            let start = Instant::now();
            let actions = match call {
                Call::Decision => runtime.segment(row)?,
                Call::Action => runtime.action(Some(row))?,
            };
            std::hint::black_box(actions);
            took.push(start.elapsed().as_secs_f64() * 1e6);
        }
        Ok(took)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_ignore_the_order_of_calls() {
        let latency = Latency::of((1..=200).rev().map(f64::from).collect()).unwrap();
        assert_eq!(latency, Latency { p50_us: 100.0, p99_us: 198.0, max_us: 200.0 });
        assert_eq!(Latency::of(vec![3.0]).unwrap().p99_us, 3.0);
        assert_eq!(Latency::of(Vec::new()), None);
    }
}
