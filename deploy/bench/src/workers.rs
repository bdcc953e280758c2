//! The workers of a run, with a [`DrainReceiver`] in place of the learner.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use dmprl_control::{Command, Report};
use dmprl_run::Setup;
use dmprl_run::Watch;
use dmprl_run::{Manifest, RunDirectory};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::parameters::ParameterSnapshot;
use dmprl_shared::policy::Policy;
use dmprl_shared::seeds;
use dmprl_shared::segment::Expected;
use dmprl_shared::spec::EnvSpec;
use dmprl_shared::transport::ParameterPublisher;
use dmprl_shared::transport::delivery::Inbox;
use dmprl_shared::transport::shared_memory::{Domain, Plan, serve};
use dmprl_supervisor::{Launcher, Process, TimeLimits, create_domain};
use tempfile::TempDir;

use super::child::LineChild;
use super::drain_receiver::{
    Answer, Discrepancies, DrainReceiver, DrainWindow, Request, Source, show_warning,
};
use super::round::Round;

/// Time beyond a measurement's duration until it times out.
const MEASURE_SLACK: Duration = Duration::from_secs(30);

/// Workers warn when a send takes longer than this [s]. Waiting for the next round is normal.
const SEND_DEADLINE_S: f64 = 1e6;

/// A temporary run directory and shared memory for workers without a learner, removed on drop.
pub(super) struct BenchRun {
    pub(super) launcher: Launcher,
    pub(super) domain: Domain,
    pub(super) manifest: Manifest,
    /// The last field, so that it is removed after its users are dropped.
    _folder: TempDir,
}

impl BenchRun {
    /// Creates the run directory and the shared memory.
    pub(super) fn new(
        program: PathBuf,
        venv: PathBuf,
        config: &ExperimentConfig,
    ) -> anyhow::Result<Self> {
        let mut config = config.clone();
        config.actors.send_deadline_s = SEND_DEADLINE_S;
        // No workers join during a benchmark.
        config.actors.joined_max = 0;
        let folder = tempfile::Builder::new().prefix("dmprl-bench-").tempdir();
        let folder = folder.context("cannot make a folder for the workers' run")?;
        let manifest = Manifest::new(None)?;
        let run = RunDirectory::create(&folder.path().join("run"), &config, &manifest)?;
        let domain = create_domain(&format!("{}-{}", manifest.run_id, std::process::id()))?;
        let launcher = Launcher {
            domain: Some(domain.path().to_owned()),
            ..Launcher::outside_training(program, &run, Some(venv))
        };
        Ok(Self { launcher, domain, manifest, _folder: folder })
    }
}

/// Running workers. Their queues are full between two measurements.
pub(super) struct Workers {
    children: Vec<LineChild>,
    receiver: DrainReceiver,
    discrepancies: Discrepancies,
    /// Environment spec, as reported by a worker.
    pub(super) spec: EnvSpec,
    pub(super) policy: Policy,
    pub(super) parameters: Vec<f32>,
    /// Environment steps in a segment of each of a worker's environments.
    steps_at_once: u64,
    /// Time from start to first delivered segment of the slowest worker [s].
    pub(super) first_segment_s: f64,
}

impl Workers {
    /// Starts the workers; returns when each has delivered its first segment.
    pub(super) fn start(run: &BenchRun, watch: &Watch) -> anyhow::Result<Self> {
        let BenchRun { launcher, domain, .. } = run;
        let setup = Setup::read(launcher.run.path())?;
        let config = &setup.config;
        let limit = TimeLimits::default().ready;
        let mut children = Vec::with_capacity(config.actors.workers);
        for index in 0..u32::try_from(config.actors.workers).context("too many workers")? {
            let process = Process::Actor(index);
            let log = launcher.run.log_path(&process.to_string());
            let command = launcher.command(process, 0)?;
            children.push(LineChild::start(process.to_string(), command, &log)?);
        }
        let mut spec = None;
        for child in &mut children {
            spec = Some(receive_spec(child, watch, limit)?);
        }
        let spec = spec.context("no worker")?;
        let policy = Policy::new(config.policy_description(&spec))?;
        let mut random = seeds::stream(config.run.seed, "actor parameters", 0);
        let snapshot = ParameterSnapshot {
            version: 1,
            // Past the warm-up, so that the network decides from the first segment on.
            env_steps: config.exploration.warm_up_steps,
            architecture_hash: policy.architecture_hash(),
            settled: false,
            values: policy.initial_parameters(&mut random),
        };
        let mut end = serve(domain.path(), &Plan::new(&setup.config, setup.run_id, &policy))?;
        end.parameters.publish(&snapshot)?;
        let expected = expected(&setup, &policy)?;
        let inbox = Inbox::new(expected.worker_count as usize);
        let receiver =
            DrainReceiver::start(end, expected, setup.config.actors.queue_segments, inbox);
        let mut workers = Self {
            children,
            receiver,
            discrepancies: Discrepancies::default(),
            spec,
            steps_at_once: (config.actors.envs_per_worker * policy.layout().segment_steps) as u64,
            policy,
            parameters: snapshot.values,
            first_segment_s: 0.0,
        };
        workers.attach(domain, watch, limit)?;
        Ok(workers)
    }

    /// Measures the rate of all workers together, and the receiver's own load.
    pub(super) fn measure(
        &mut self,
        watch: &Watch,
        duration: Duration,
    ) -> anyhow::Result<(Round, DrainWindow)> {
        self.measure_source(watch, duration, Source::All)
    }

    /// Measures the first worker while the others sleep because their queues are full. Returns
    /// `None` if there is only one worker. The queues must have had time to fill.
    ///
    /// The others do not get SIGSTOP: a stopped process would outlive a killed benchmark.
    pub(super) fn measure_first(
        &mut self,
        watch: &Watch,
        duration: Duration,
    ) -> anyhow::Result<Option<Round>> {
        if self.children.len() == 1 {
            return Ok(None);
        }
        Ok(Some(self.measure_source(watch, duration, Source::First)?.0))
    }

    fn measure_source(
        &mut self,
        watch: &Watch,
        duration: Duration,
        source: Source,
    ) -> anyhow::Result<(Round, DrainWindow)> {
        let (start, cpu_s) = (Instant::now(), self.cpu_s(source));
        // A worker sends its environments' segments together, so fewer would be a part of them.
        let steps_min = self.count(source) as u64 * self.steps_at_once;
        let request = Request::Measure { duration, source, steps_min };
        let answer = self.ask(request, watch, duration + MEASURE_SLACK)?;
        let Answer::Measured(window) = answer else {
            bail!("the receiver sent an unexpected answer");
        };
        // Includes the settling time, during which the workers run in the same way.
        let elapsed_s = start.elapsed().as_secs_f64();
        let cores = self.cpu_s(source).zip(cpu_s).map(|(now, then)| (now - then) / elapsed_s);
        let steps_per_s = window.env_steps as f64 / window.seconds;
        Ok((Round { steps_per_s, cores }, window))
    }

    fn cpu_s(&self, source: Source) -> Option<f64> {
        self.children.iter().take(self.count(source)).map(LineChild::cpu_s).sum()
    }

    /// Returns the number of workers of a source.
    fn count(&self, source: Source) -> usize {
        match source {
            Source::All => self.children.len(),
            Source::First => 1,
        }
    }

    /// Rejected and lost segments so far.
    pub(super) fn discrepancies(&self) -> Discrepancies {
        self.discrepancies
    }

    /// Peak resident memory of the largest worker [bytes].
    pub(super) fn resident_bytes_max(&self) -> Option<u64> {
        self.children.iter().filter_map(LineChild::resident_bytes_max).max()
    }

    fn attach(&mut self, domain: &Domain, watch: &Watch, limit: Duration) -> anyhow::Result<()> {
        let command = Command::Attach { domain: domain.path().to_owned() };
        let line = serde_json::to_string(&command).context("cannot write a command as JSON")?;
        for child in &mut self.children {
            child.send_line(&line)?;
        }
        let Answer::FirstOfEach(first) = self.ask(Request::FirstOfEach, watch, limit)? else {
            bail!("the receiver sent an unexpected answer");
        };
        ensure!(first.len() == self.children.len(), "not every worker delivered a segment");
        let waits = self.children.iter().zip(first).map(|(child, at)| at - child.started());
        self.first_segment_s = waits.max().unwrap_or_default().as_secs_f64();
        Ok(())
    }

    /// Sends a request to the receiver, and checks on the workers until it answers.
    fn ask(&mut self, request: Request, watch: &Watch, limit: Duration) -> anyhow::Result<Answer> {
        let (answer, discrepancies) =
            self.receiver.answer(request, &mut self.children, watch, limit)?;
        self.discrepancies = discrepancies;
        Ok(answer)
    }
}

/// Waits until a worker has created its environments, and returns their spec.
fn receive_spec(child: &mut LineChild, watch: &Watch, limit: Duration) -> anyhow::Result<EnvSpec> {
    let deadline = Instant::now() + limit;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let line = child.next_line(watch, left, "the environments")?;
        match serde_json::from_str(&line) {
            Ok(Report::EnvironmentReady { spec }) => return Ok(spec),
            Ok(_) => show_warning(child.name(), &line),
            Err(_) => return Err(anyhow!("{} sent an invalid report: {line}", child.name())),
        }
    }
}

fn expected(setup: &Setup, policy: &Policy) -> anyhow::Result<Expected> {
    let ExperimentConfig { actors, .. } = &setup.config;
    Ok(Expected {
        run_id: setup.run_id,
        architecture_hash: policy.architecture_hash(),
        layout: policy.layout(),
        action_bounds: policy.action_bounds(),
        worker_count: u32::try_from(actors.workers).context("too many workers")?,
        env_count: u32::try_from(actors.envs_per_worker).context("too many environments")?,
    })
}
