//! A run directory whose children are played by `fake_role.sh`.
#![allow(dead_code, missing_docs)] // each test program uses a part of it

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dmprl::terminal::Display;
use dmprl_run::{LockWatch, Manifest, RunDirectory};
use dmprl_shared::config::ExperimentConfig;
use dmprl_shared::spec::EnvSpec;
use dmprl_supervisor::{Launcher, SessionReport, SupervisorPlan, TimeLimits, Totals, supervise};
use tokio::sync::mpsc;

/// Time limit of all waits in tests.
pub const PATIENCE: Duration = Duration::from_secs(60);

pub struct Fixture {
    pub run: RunDirectory,
    pub config: ExperimentConfig,
    pub limits: TimeLimits,
    pub one_process: bool,
    pub interrupted_twice: bool,
    _parent: tempfile::TempDir,
}

/// Output of the display, which tests read.
#[derive(Clone, Default)]
pub struct Screen(Arc<Mutex<Vec<u8>>>);

impl Screen {
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.0.lock().unwrap()).into_owned()
    }
}

impl Write for Screen {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Fixture {
    /// Creates a run with two workers. `fakes` are pairs of a process and its mode; other processes
    /// have the mode `normal`.
    pub fn new(fakes: &[(&str, &str)]) -> Self {
        let parent = tempfile::tempdir().unwrap();
        let mut config = ExperimentConfig::default();
        config.actors.workers = 2;
        // Most fakes send no heartbeats.
        config.supervision.heartbeat_timeout_s = PATIENCE.as_secs_f64() * 10.0;
        let manifest = Manifest::new(None).unwrap();
        let run = RunDirectory::create(&parent.path().join("run"), &config, &manifest).unwrap();
        let folder = run.path().join("fake");
        fs::create_dir(&folder).unwrap();
        for (name, mode) in fakes {
            fs::write(folder.join(name), format!("{mode}\n")).unwrap();
        }
        let limits = TimeLimits {
            restart_first: Duration::from_millis(10),
            restart_max: Duration::from_millis(50),
            ..TimeLimits::default()
        };
        Self { run, config, limits, one_process: false, interrupted_twice: false, _parent: parent }
    }

    pub fn spec(&self) -> EnvSpec {
        EnvSpec::new("Fake-v0", 2, &[(-1.0, 1.0)], 0.02, 50)
    }

    /// Supervises the run, which must end by itself.
    pub fn supervise(&self) -> (SessionReport, String) {
        self.supervise_with(None)
    }

    /// Supervises the run, and interrupts it when the screen shows `text`.
    pub fn supervise_until(&self, text: &str) -> (SessionReport, String) {
        self.supervise_with(Some(text))
    }

    fn supervise_with(&self, interrupt_at: Option<&str>) -> (SessionReport, String) {
        let (sender, interrupts) = mpsc::channel(4);
        let screen = Screen::default();
        let mut watched = screen.clone();
        writeln!(watched, "training").unwrap();
        let plan = plan(&self.run, &self.config, self.limits, self.one_process, interrupts);
        let mut display = Display::lines(Box::new(screen.clone()), self.config.run.steps);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let watch = async {
                let Some(text) = interrupt_at else { std::future::pending().await };
                while !watched.text().contains(text) {
                    tokio::task::yield_now().await;
                }
                sender.send(()).await.unwrap();
                // Two interrupts within a short time count as one, so the second is repeated.
                while self.interrupted_twice && !watched.text().contains("interrupted twice") {
                    let _ = sender.try_send(());
                    tokio::task::yield_now().await;
                }
                std::future::pending::<()>().await;
            };
            let ended = tokio::select! {
                report = tokio::time::timeout(PATIENCE, supervise(plan, &mut display)) => report,
                () = watch => unreachable!(),
            };
            let report = ended.unwrap_or_else(|_| panic!("no end:\n{}", screen.text()));
            (report, screen.text())
        })
    }

    /// Returns the log of a fake.
    pub fn seen(&self, name: &str) -> String {
        let path = self.run.path().join("fake").join(format!("{name}.seen"));
        fs::read_to_string(path).unwrap_or_default()
    }

    pub fn assert_no_child_lives(&self) {
        let living = living_children(self.run.path());
        assert!(living.is_empty(), "still there: {living:?}");
    }
}

/// Path of the program that plays every role.
pub fn fake_role() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fake_role.sh")
}

/// Creates a plan with fakes for children.
pub fn plan(
    run: &RunDirectory,
    config: &ExperimentConfig,
    limits: TimeLimits,
    one_process: bool,
    interrupts: mpsc::Receiver<()>,
) -> SupervisorPlan {
    let launcher = Launcher {
        program: fake_role(),
        run: run.clone(),
        venv: None,
        // Any directory: the fakes share no memory.
        domain: (!one_process).then(|| run.path().to_owned()),
        resume: false,
        init_from: None,
        learner_restarts: 0,
        sessions_before: 0,
        journal: None,
        upstream: None,
    };
    let (config, earlier) = (config.clone(), Totals::default());
    let lock = LockWatch::default();
    SupervisorPlan { launcher, lock, config, limits, earlier, interrupts }
}

/// Lists the process ids of a run's living fakes, without zombies.
pub fn living_children(run: &Path) -> Vec<String> {
    let pids = fs::read_to_string(run.join("fake/pids")).unwrap_or_default();
    let lives = |pid: &&str| {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        let command = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let dead = status.lines().any(|line| line.starts_with("State:") && line.contains('Z'));
        command.contains("fake_role") && !dead
    };
    pids.lines().filter(lives).map(str::to_owned).collect()
}

/// Waits until the condition holds.
pub fn until(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "waited {PATIENCE:?} in vain: {what}");
        std::thread::yield_now();
    }
}
