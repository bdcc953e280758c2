//! Shared memory between processes that only send and a [`DrainReceiver`] in place of the learner.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use dmprl_control::Report;
use dmprl_run::Watch;
use dmprl_shared::config::DeliveryLevel;
use dmprl_shared::transport::delivery::{Inbox, LogIdentity, SegmentLog, Sent};
use dmprl_shared::transport::shared_memory::{Domain, serve};
use dmprl_supervisor::create_domain;

use crate::child::LineChild;
use crate::drain_receiver::{
    Answer, Discrepancies, DrainReceiver, DrainWindow, Request, Source, show_warning,
};
use crate::synthetic_segments::Size;

/// Time limit from the start of the processes to the first segment of each.
const START: Duration = Duration::from_secs(60);
/// Time beyond a measurement's duration until it times out.
const MEASURE_SLACK: Duration = Duration::from_secs(30);
/// Time limit for a worker to stop. It normally answers within milliseconds.
const STOP: Duration = Duration::from_secs(30);
/// Duration of each attempt to receive the remaining segments, and of all attempts together. On a
/// busy machine, this can take several attempts. Segments still missing at the end count as lost.
const DRAIN: Duration = Duration::from_millis(100);
const DRAIN_MAX: Duration = Duration::from_secs(10);

/// Capacity of the log, which is cleared like after a checkpoint to limit its size on disk.
const LOG_BYTES_MAX: u64 = 256 << 20;

/// Running workers that send segments of one size. Their queues are full between two measurements.
pub(super) struct SharedMemory {
    pub(super) size: Size,
    children: Vec<LineChild>,
    receiver: DrainReceiver,
    discrepancies: Discrepancies,
    /// The last field, so that it is removed after its users are dropped.
    _domain: Domain,
}

impl SharedMemory {
    /// Starts the workers and waits for the first segment of each. `command` creates a
    /// `transport-worker` for this size, without its route.
    pub(super) fn start(
        size: Size,
        workers: u32,
        token: &str,
        command: &dyn Fn() -> Command,
        level: DeliveryLevel,
        folder: &Path,
        watch: &Watch,
    ) -> anyhow::Result<Self> {
        let domain = create_domain(token)?;
        let plan = size.plan(workers as usize);
        let end = serve(domain.path(), &plan)?;
        let mut inbox = Inbox::new(workers as usize);
        if level == DeliveryLevel::Log {
            let path = folder.join(format!("segments-{}.log", size.bytes));
            let (run_id, architecture_hash) = (plan.run_id, plan.architecture_hash);
            let identity = LogIdentity { run_id, architecture_hash };
            inbox.log_to(SegmentLog::open(&path, identity, plan.layout, LOG_BYTES_MAX)?);
        }
        let receiver =
            DrainReceiver::start(end, size.expected(workers), plan.queue_segments, inbox);
        let mut children = Vec::new();
        for index in 0..workers {
            let name = format!("worker-{index}-{}", size.bytes);
            let path = folder.join(format!("{name}.log"));
            let log =
                File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
            let mut command = command();
            command.args(["--index", &index.to_string(), "--workers", &workers.to_string()]);
            command.arg("--shared-memory").arg(domain.path()).stderr(log);
            children.push(LineChild::start(name, command, &path)?);
        }
        let discrepancies = Discrepancies::default();
        let mut shared_memory = Self { size, children, receiver, discrepancies, _domain: domain };
        shared_memory.ask(Request::FirstOfEach, watch, START)?;
        Ok(shared_memory)
    }

    /// Counts the segments of all workers during `duration`.
    pub(super) fn measure(
        &mut self,
        watch: &Watch,
        duration: Duration,
    ) -> anyhow::Result<DrainWindow> {
        let request = Request::Measure { duration, source: Source::All, steps_min: 0 };
        match self.ask(request, watch, duration + MEASURE_SLACK)? {
            Answer::Measured(window) => Ok(window),
            Answer::FirstOfEach(_) => bail!("the receiver sent an unexpected answer"),
        }
    }

    /// Returns the processor time of each worker so far \[s\], if the system reports it.
    pub(super) fn cpu_s(&self) -> Option<Vec<f64>> {
        self.children.iter().map(LineChild::cpu_s_of_all_threads).collect()
    }

    /// Stops the workers, receives the remaining segments and compares their number with the
    /// workers' reports.
    pub(super) fn finish(mut self, watch: &Watch) -> anyhow::Result<Discrepancies> {
        let mut sent = 0;
        for child in &mut self.children {
            child.send_line("\"stop\"")?;
            sent += last_report(child, watch)?.sent;
        }
        // The workers have exited as requested: do not check on them any more.
        self.children.clear();
        let start = Instant::now();
        loop {
            let request = Request::Measure { duration: DRAIN, source: Source::All, steps_min: 0 };
            self.ask(request, watch, DRAIN + MEASURE_SLACK)?;
            if self.discrepancies.received >= sent || start.elapsed() >= DRAIN_MAX {
                break;
            }
        }
        let Discrepancies { received, lost, .. } = self.discrepancies;
        // Gaps within a sequence, or segments missing at its end.
        let lost = lost.max(sent.saturating_sub(received));
        Ok(Discrepancies { lost, ..self.discrepancies })
    }

    fn ask(&mut self, request: Request, watch: &Watch, limit: Duration) -> anyhow::Result<Answer> {
        let (answer, discrepancies) =
            self.receiver.answer(request, &mut self.children, watch, limit)?;
        self.discrepancies = discrepancies;
        Ok(answer)
    }
}

/// Receives a worker's final report, with the number of segments that it sent.
fn last_report(child: &mut LineChild, watch: &Watch) -> anyhow::Result<Sent> {
    let deadline = Instant::now() + STOP;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let line = child.next_line(watch, left, "the last report")?;
        match serde_json::from_str(&line) {
            Ok(Report::Sent(sent)) => return Ok(sent),
            Ok(_) => show_warning(child.name(), &line),
            Err(_) => return Err(anyhow!("{} sent an invalid report: {line}", child.name())),
        }
    }
}
