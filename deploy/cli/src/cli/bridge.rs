//! `dmprl bridge`: runs workers on this host for a run whose learner is on another.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::Args;
use dmprl_bridge::host_messages::HostWelcome;
use dmprl_bridge::join::{JoinOutcome, JoinSettings, explain_silence, request_join};
use dmprl_bridge::{Link, LinkMode, token};
use dmprl_run::Watch;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::grouped;
use dmprl_run::{
    Manifest, RunDirectory, RunLock, Session, compact_now, random_u64, replace_file, safe_name,
};
use dmprl_shared::config::endpoint::{is_endpoint, is_plain};
use dmprl_shared::config::{BridgeConfig, ExperimentConfig, Layers, Limits, TASKS, TaskConfig};
use dmprl_supervisor::capacity;
use dmprl_supervisor::{self as launch, Ending, HostPlan, SessionReport, Upstream};
use toml::Table;

use super::configuration::{add_env_kwargs, refuse};
use super::output::{OutputArgs, host_observer};
use super::{cores, prepare_python, this_program};
use crate::terminal::{ProgressStyle, events, say, write_line};

/// Interval between two join requests.
const JOIN_INTERVAL: Duration = Duration::from_millis(500);

/// Wait for the processes of a killed bridge to exit. They do so at once, unless the machine is
/// very busy.
const LEFT_OVER: Duration = Duration::from_secs(60);
/// File in a bridge's directory with the number that identifies this host to the learner's host.
const HOST_FILE: &str = "bridge.host";

const HELP: &str = "\
Both hosts need a program that was built with: cargo build --release --features hosts
On the learner's host, start the run with bridge.listen. Copy its token, bridge.token in the run's
directory, to the other hosts; only its owner may have access to the file:
  dmprl train reacher --set 'bridge.listen=[\"tls/0.0.0.0:7447\"]' --run-dir runs/mine
Both ends prove that they know the token without sending it, and make the certificates of tls/ from
it. This host receives configuration and policies from the learner's host, but only your own command
line decides which Python code it imports: a task other than dmprl's own needs --task.
It needs the same version of dmprl, waits while the learner's host is unreachable, and exits when
the run ends. On Ctrl-C the workers' last segments are delivered, and the other hosts continue; a
second Ctrl-C exits at once. Exit status: 0 the run has ended, 130 interrupted, 2 rejected, 1 failed
or waited longer than --patience.

EXAMPLES
  dmprl bridge --connect tls/10.0.0.1:7447 --token-file bridge.token
  dmprl bridge --connect tls/10.0.0.1:7447 --token-file bridge.token --workers 16 --name gpu3
  dmprl bridge --connect tls/10.0.0.1:7447 --token-file bridge.token --task lift:Lift \\
      --python-path envs";

/// Arguments of `dmprl bridge`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct BridgeArgs {
    /// Zenoh endpoint of the learner's host: tls/ADDRESS:PORT, or tcp/ADDRESS:PORT on loopback.
    #[arg(long, value_name = "ENDPOINT")]
    connect: String,
    /// Connect also to tcp/ endpoints beyond loopback. Others on the network can then read the
    /// messages, but not forge them.
    #[arg(long)]
    allow_plain: bool,
    /// File with the run's token, mode 0600.
    #[arg(long, value_name = "FILE")]
    token_file: PathBuf,
    /// Workers on this host [default: one per core].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    workers: Option<u16>,
    /// Name of this host in the run's displays [default: the host's name].
    #[arg(long)]
    name: Option<String>,
    /// Directory for this host's logs; may be that of an earlier bridge of the same run [default:
    /// runs/bridge-NAME-TIME].
    #[arg(long, value_name = "DIR")]
    run_dir: Option<PathBuf>,
    /// Gymnasium id or class of the run's environment, if it is not one of dmprl's own tasks
    /// (dmprl tasks). The host rejects a run with another one.
    #[arg(long, value_name = "ID")]
    task: Option<String>,
    /// Argument of the run's environment, as given to dmprl train; repeatable. The host rejects a
    /// run with others.
    #[arg(long, value_name = "KEY=VALUE")]
    env_kwargs: Vec<String>,
    /// Wrapper of the run's environment (task.wrappers); repeatable. The host rejects a run with
    /// others.
    #[arg(long, value_name = "MODULE:NAME")]
    wrapper: Vec<String>,
    /// Directory of your own environment modules on this host; repeatable.
    #[arg(long, value_name = "DIR")]
    python_path: Vec<PathBuf>,
    /// Zenoh configuration file (JSON5), for certificates.
    #[arg(long, value_name = "FILE")]
    zenoh_config: Option<PathBuf>,
    /// How long to wait while the learner's host is unreachable [min].
    #[arg(long, value_name = "M", default_value_t = 60,
          value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    patience: u64,
    #[command(flatten)]
    pub(super) output: OutputArgs,
}

pub(super) fn run(args: &BridgeArgs) -> anyhow::Result<Outcome> {
    dmprl_bridge::check_available()?;
    let absolute = |path: &PathBuf| {
        std::path::absolute(path).with_context(|| format!("cannot resolve {}", path.display()))
    };
    let zenoh_file = args.zenoh_config.as_ref().map(absolute).transpose()?;
    let token_file = absolute(&args.token_file)?;
    let workers = args.workers.map_or_else(cores, usize::from);
    let earlier = earlier(args)?;
    let join = JoinSettings {
        endpoint: endpoint(args)?,
        token: token::read(&token_file)?,
        host: earlier.as_ref().map_or_else(random_u64, |(_, host)| Ok(*host))?,
        name: args.name.clone().unwrap_or_else(host_name),
        workers: u32::try_from(workers).context("too many workers")?,
    };
    let patience = Duration::from_secs(args.patience * 60);
    let venv = prepare_python()?;
    let welcome = wait_for_welcome(&join, zenoh_file.as_deref(), patience)?;
    let Some(welcome) = welcome else { return Ok(Outcome::Interrupted) };
    let config = host_config(&welcome, workers, args)?;
    capacity::check(&config, Some(&welcome.spec))?;
    let run = run_directory(args, &join.name, &welcome, &config)?;
    let lock = match earlier {
        Some((lock, _)) => lock,
        None => run.lock(Duration::ZERO)?,
    };
    replace_file(&run.path().join(HOST_FILE), format!("{:016x}", join.host).as_bytes())?;
    let upstream = Upstream {
        endpoint: join.endpoint,
        token_file,
        host: join.host,
        name: join.name,
        first: welcome.lease.first,
        zenoh_file,
        patience_s: patience.as_secs(),
    };
    let (program, session) = (this_program()?, welcome.lease.session);
    let style = args.output.style();
    let mut observer = host_observer(style, &config.run);
    let plan = HostPlan { program, run, lock: lock.watch(), config, venv, upstream, session };
    let report = launch::host(plan, observer.as_mut())?;
    drop(lock);
    conclude(report, style)
}

fn conclude(report: SessionReport, style: ProgressStyle) -> anyhow::Result<Outcome> {
    if style == ProgressStyle::Events {
        write_line(&events::finished(&report));
    }
    let segments = report.last.as_ref().map_or(0, |progress| progress.segments);
    let (outcome, what) = match report.ending {
        Ending::Failed(error) => return Err(error),
        Ending::Interrupted => (Outcome::Interrupted, "left the run"),
        Ending::Completed => (Outcome::Done, "the run has ended"),
    };
    if style != ProgressStyle::Events {
        say(&format!("{what}: {} segments acknowledged", grouped(segments)));
    }
    Ok(outcome)
}

/// Locks the directory of an earlier bridge and reads its host number. With this number a restarted
/// bridge gets its leases back at once; otherwise they would stay reserved for minutes.
fn earlier(args: &BridgeArgs) -> anyhow::Result<Option<(RunLock, u64)>> {
    let Some(path) = args.run_dir.as_deref().filter(|path| path.join(HOST_FILE).is_file()) else {
        return Ok(None);
    };
    let lock = RunDirectory::open(path)?.lock(LEFT_OVER)?;
    let file = path.join(HOST_FILE);
    let read = || format!("cannot read {}", file.display());
    let text = std::fs::read_to_string(&file).with_context(read)?;
    Ok(Some((lock, u64::from_str_radix(text.trim(), 16).with_context(read)?)))
}

fn endpoint(args: &BridgeArgs) -> anyhow::Result<String> {
    let text = &args.connect;
    if !is_endpoint(text) {
        return Err(wrong_use(format!(
            "--connect {text}: expected tls/ADDRESS:PORT or tcp/ADDRESS:PORT, such as \
             tls/10.0.0.1:7447"
        )));
    }
    if is_plain(text) && !args.allow_plain {
        return Err(wrong_use(format!(
            "--connect {text}: others on the network could read the messages; use {}, with which \
             the run listens on tls/ too, or add --allow-plain",
            text.replacen("tcp/", "tls/", 1)
        )));
    }
    Ok(text.clone())
}

fn host_name() -> String {
    let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
    if name.is_empty() { "host".to_owned() } else { name }
}

/// Asks the learner's host until it accepts this one; `None` on interrupt.
fn wait_for_welcome(
    join: &JoinSettings,
    zenoh_file: Option<&Path>,
    patience: Duration,
) -> anyhow::Result<Option<HostWelcome>> {
    let watch = Watch::start()?;
    let link = Link::open(LinkMode::Connect(&join.endpoint), &join.token, zenoh_file)?;
    let (began, mut last_reason) = (Instant::now(), String::new());
    loop {
        if watch.check().is_err() {
            return Ok(None);
        }
        let reason = match request_join(&link, join, None)? {
            JoinOutcome::Welcome(admission) => return Ok(Some(admission.welcome)),
            JoinOutcome::Refused(reason) => {
                return Err(wrong_use(format!(
                    "the learner's host at {} rejects this host: {reason}",
                    join.endpoint
                )));
            }
            JoinOutcome::Silent => explain_silence(&join.endpoint),
            JoinOutcome::Later(reason) => reason,
        };
        let minutes = patience.as_secs() / 60;
        if began.elapsed() >= patience {
            bail!("waited {minutes} min: {reason}");
        }
        if reason != last_reason {
            say(&format!("{reason}; waiting for at most {minutes} min"));
            last_reason = reason;
        }
        std::thread::sleep(JOIN_INTERVAL);
    }
}

/// Adapts the run's configuration to this host. What this host imports and which files it reads
/// comes from its own command line.
fn host_config(
    welcome: &HostWelcome,
    workers: usize,
    args: &BridgeArgs,
) -> anyhow::Result<ExperimentConfig> {
    let mut config: ExperimentConfig = toml::from_str(&welcome.config)
        .context("the learner's host sent an unreadable configuration")?;
    config.actors.workers = workers;
    config.actors.joined_max = 0;
    config.bridge = BridgeConfig {
        under_way_bytes_max: config.bridge.under_way_bytes_max,
        ..BridgeConfig::default()
    };
    config.demonstrations.files.clear();
    // This host has no replay.
    config.replay.capacity_steps = 1_000;
    config.run.max_minutes = f64::INFINITY;
    // Names every field, so that a new one is not taken from the network by accident.
    let TaskConfig { name, id, python_path: _, start_sources, wrappers, kwargs, randomise } =
        config.task;
    check_task(&id, args)?;
    check_options(&kwargs, &wrappers, args)?;
    let absolute = |path: &PathBuf| {
        let path = std::fs::canonicalize(path)
            .map_err(|error| wrong_use(format!("--python-path {}: {error}", path.display())))?;
        Ok(path.display().to_string())
    };
    let python_path = args.python_path.iter().map(absolute).collect::<anyhow::Result<_>>()?;
    config.task = TaskConfig { name, id, python_path, start_sources, wrappers, kwargs, randomise };
    config.resolve(Limits { cores: cores() }).map_err(refuse)
}

/// Checks that the user named the arguments and wrappers of the run's environment on this host: a
/// wrapper is code, and an argument can name code or a file. A time limit needs no name.
fn check_options(kwargs: &Table, wrappers: &[String], args: &BridgeArgs) -> anyhow::Result<()> {
    let mut named = Layers::new();
    add_env_kwargs(&mut named, &args.env_kwargs)?;
    let named = named.finish().map_err(refuse)?.task.kwargs;
    let is_time_limit = |name: &str| name == "max_episode_steps" && !named.contains_key(name);
    let asked = || kwargs.iter().filter(|(name, _)| !is_time_limit(name));
    if named.iter().eq(asked()) && args.wrapper == wrappers {
        return Ok(());
    }
    let arguments =
        asked().map(|(name, value)| format!(" --env-kwargs {:?}", format!("{name}={value}")));
    let wrappers = wrappers.iter().map(|wrapper| format!(" --wrapper {wrapper:?}"));
    let flags: String = arguments.chain(wrappers).collect();
    let expected = if flags.is_empty() { " no --env-kwargs and no --wrapper" } else { &flags };
    Err(wrong_use(format!(
        "the run's environment has other arguments or wrappers than this command line names; to \
         run it on this host, expected:{expected}"
    )))
}

/// Checks that this host may import the run's environment: a task of dmprl, or one that the user
/// named. Any other id can import a module: as its part before a colon, or by the registration of
/// an installed package.
fn check_task(id: &str, args: &BridgeArgs) -> anyhow::Result<()> {
    let is_own = TASKS.iter().any(|task| task.id == id);
    let shown = id.escape_debug();
    match &args.task {
        Some(named) if named == id => Ok(()),
        Some(named) => Err(wrong_use(format!(
            "--task {named}: the run's environment is {shown}; pass that to run it on this host"
        ))),
        None if is_own => Ok(()),
        None => Err(wrong_use(format!(
            "the run's environment {shown} is not one of dmprl's own, so this host runs it only if \
             you name it, with --python-path if it is your own code: dmprl bridge --connect {} \
             --token-file {} --task '{shown}'",
            args.connect,
            args.token_file.display()
        ))),
    }
}

/// Creates this bridge's run directory, or opens that of an earlier bridge of the same run.
fn run_directory(
    args: &BridgeArgs,
    name: &str,
    welcome: &HostWelcome,
    config: &ExperimentConfig,
) -> anyhow::Result<RunDirectory> {
    let named = format!("bridge-{}-{}", safe_name(name), compact_now());
    let path = args.run_dir.clone().unwrap_or_else(|| Path::new("runs").join(named));
    let run = if path.join("manifest.json").is_file() {
        let run = RunDirectory::open(&path)?;
        let mut manifest = run.manifest()?;
        if manifest.run_id != welcome.run_id {
            return Err(wrong_use(format!(
                "{} belongs to run {}, but the learner's host trains run {}: choose another \
                 --run-dir",
                path.display(),
                manifest.run_id,
                welcome.run_id
            )));
        }
        manifest.sessions.push(Session::now());
        run.write_manifest(&manifest)?;
        run.write_config(config)?;
        run
    } else {
        let manifest = Manifest { run_id: welcome.run_id.clone(), ..Manifest::new(None)? };
        RunDirectory::create(&path, config, &manifest)?
    };
    run.write_spec(&welcome.spec)?;
    Ok(run)
}
