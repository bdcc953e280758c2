//! `dmprl train`: creates a run directory from the command line and trains it.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::Context;
use clap::Args;
use clap::builder::PossibleValuesParser;
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::grouped;
use dmprl_run::{Manifest, PolicyChoice, RunDirectory, Zoo, compact, safe_name};
use dmprl_shared::config::{ExperimentConfig, Limits, PolicyKind, TaskDefaults, task_defaults};
use dmprl_shared::dmp::Dmp;
use dmprl_supervisor::Trial;
use dmprl_supervisor::capacity;
use toml::Value;

use super::configuration::{Flag, merge, refuse};
use super::configured::{ConfiguredArgs, check_build, flag, integer, make_absolute, paths};
use super::demos::ForeignSources;
use super::output::OutputArgs;
use super::trust::{Said, TrustArgs, mark_as_own};
use super::{
    TrainingPlan, cores, name_limits, open_run, prepare_python, this_program, train_session,
    training_session,
};
use crate::terminal::say;

/// Runs created within one second get a number; this many mean that the clock is stuck.
const SAME_SECOND_MAX: usize = 100;

const HELP: &str = "\
PRECEDENCE, lowest first: defaults of the task and of the policy, --preset, defaults of the
algorithm (ndp), --config, environment variables (DMPRL_ALGORITHM__BATCH_SIZE=64 sets
algorithm.batch_size), --set, the other flags above.
Ctrl-C writes a checkpoint and exits within 10 s; a second Ctrl-C exits at once.

EXAMPLES
  dmprl train reacher
  dmprl train pusher --steps 100000 --workers 4 --seed 2
  dmprl train reacher --policy mlp --run-dir runs/baseline
  dmprl train reacher --preset paper --set exploration.std=0.2
  dmprl train panda-reach --algo ndp
  dmprl train reacher --until-return -5 --max-minutes 30
  dmprl train reacher --config runs/baseline/config.toml --deterministic
  dmprl train reacher --init-from runs/baseline --seed 3
  dmprl train panda-reach --demos demos.npz
  dmprl train my_module:MyPen-v0 --demos minari:D4RL/pen/human-v2
  dmprl train my_module:MyArm-v0 --python-path ./envs
  dmprl train gymnasium_robotics:FetchReach-v4 --env-kwargs reward_type=dense
  dmprl train my_module:MyArm --python-path ./envs --env-kwargs 'gains=[1.0, 2.5]'";

/// Arguments of `dmprl train`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct TrainArgs {
    /// A task of `dmprl tasks`; any Gymnasium id, such as Pendulum-v1 or my_module:MyArm-v0; or
    /// your own gymnasium.Env, VectorEnv or SegmentEnv class, as my_module:MyClass.
    task: String,
    #[command(flatten)]
    configured: ConfiguredArgs,
    /// Length of the run in environment steps, summed over all workers.
    #[arg(long, value_name = "N", value_parser = integer())]
    steps: Option<i64>,
    /// Run directory, new or empty [default: runs/TASK-ALGO-POLICY-sSEED-TIME].
    #[arg(long, value_name = "DIR")]
    run_dir: Option<PathBuf>,
    /// Train with one worker, in lock-step with the learner in one process: runs with the same seed
    /// are bit-identical.
    #[arg(long)]
    deterministic: bool,
    /// Device of the update; `cuda` needs a build with that feature.
    #[arg(long, value_parser = PossibleValuesParser::new(["cpu", "cuda"]))]
    device: Option<String>,
    /// Threads of the update [default: 2, or 1 on one core].
    #[arg(long, value_name = "N")]
    threads: Option<u32>,
    /// Initialise the policy from a run's best policy, zoo:TASK or a policy file.
    #[arg(long, value_name = "RUN|FILE")]
    init_from: Option<PathBuf>,
    /// Demonstrations to learn from: a file of steps, or a data set of Minari (minari:ID or a
    /// folder) or LeRobot (a folder), converted as by `dmprl demos convert`; repeatable.
    #[arg(long, value_name = "SOURCE")]
    demos: Vec<PathBuf>,
    /// Stop when the mean evaluation return reaches this value.
    #[arg(long, value_name = "X", allow_negative_numbers = true)]
    until_return: Option<f64>,
    /// Stop when the evaluation success rate, 0 to 1, reaches this value.
    #[arg(long, value_name = "X")]
    until_success: Option<f64>,
    /// Stop this session after this many minutes.
    #[arg(long, value_name = "M")]
    max_minutes: Option<f64>,
    #[command(flatten)]
    trust: TrustArgs,
    #[command(flatten)]
    pub(super) output: OutputArgs,
    /// Folder in which workers and learner log every segment; for `chaos`.
    #[arg(long, value_name = "DIR", hide = true)]
    journal: Option<PathBuf>,
    /// Maximum back-off before a restart [ms]; for `chaos`.
    #[arg(long, value_name = "MS", hide = true)]
    restart_pause_max: Option<u64>,
}

/// Resolves and checks the configuration that these arguments determine.
pub(super) fn configuration(args: &TrainArgs) -> anyhow::Result<ExperimentConfig> {
    let mut config = resolved(args)?;
    make_absolute(&mut config)?;
    Ok(config)
}

/// As [`configuration`], with paths as they were given.
fn resolved(args: &TrainArgs) -> anyhow::Result<ExperimentConfig> {
    let sources = args.configured.sources(&args.task, flags(args)?)?;
    let config = merge(&sources)?.resolve(Limits { cores: cores() }).map_err(refuse)?;
    check(&config, args)?;
    Ok(config)
}

pub(super) fn run(args: &TrainArgs) -> anyhow::Result<Outcome> {
    let mut config = resolved(args)?;
    let mut foreign = ForeignSources::take(&mut config);
    make_absolute(&mut config)?;
    let said = Said {
        task: &args.task,
        file: args.configured.config.as_deref(),
        python_path: args.configured.names_python_path(),
    };
    said.check(&config, args.trust)?;
    let spec = task_defaults(&args.task).map(TaskDefaults::spec);
    capacity::check(&config, spec.as_ref())?;
    let init_from = args.init_from.as_deref().map(policy_file).transpose()?;
    if let Some(path) = &args.run_dir {
        RunDirectory::check_free(path)?;
    }
    let venv = prepare_python()?;
    let path = args.run_dir.clone().map_or_else(|| default_path(&config), Ok)?;
    foreign.convert(&mut config, &path)?;
    let session = training_session(&config, &venv)?;
    let manifest = Manifest::begin(init_from.map(|path| path.display().to_string()), session)?;
    let run = RunDirectory::create(&path, &config, &manifest)?;
    foreign.copy_to(run.path())?;
    mark_as_own(&run, &config);
    name_limits(&run);
    let lock = run.lock(Duration::ZERO)?;
    if let Some(preset) = args.configured.automatic_preset(&args.task) {
        say(&format!(
            "preset {preset}, for goals with a sparse reward (--preset default: without it)"
        ));
    }
    if args.configured.project_path(&args.task).is_some() {
        let folder = config.task.python_path.join(", ");
        say(&format!("modules from {folder}, because this folder has a pyproject.toml"));
    }
    if let Some(note) = only_warms_up(&config) {
        say(&note);
    }
    train_session(TrainingPlan {
        program: this_program()?,
        run,
        lock,
        config,
        venv: Some(venv),
        resume: false,
        progress: args.output.style(),
        trial: Trial {
            journal: args.journal.clone(),
            restart_max: args.restart_pause_max.map(Duration::from_millis),
        },
    })
}

/// Returns a note for a run that ends before the first update.
fn only_warms_up(config: &ExperimentConfig) -> Option<String> {
    let (steps, warm_up) = (config.run.steps, config.exploration.warm_up_steps);
    (steps <= warm_up && !config.demonstrations.are_cloned()).then(|| {
        format!(
            "the policy will not be updated: the run has {} steps, and the first {} are its \
             warm-up (exploration.warm_up_steps)",
            grouped(steps),
            grouped(warm_up)
        )
    })
}

/// Rejects mistakes that can be found without starting a process or an environment.
fn check(config: &ExperimentConfig, args: &TrainArgs) -> anyhow::Result<()> {
    if config.policy.kind == PolicyKind::Dmp {
        Dmp::new(&config.dmp, config.policy.segment_steps)
            .map_err(|error| wrong_use(error.to_string()))?;
    }
    check_build(config)?;
    if let Some(workers) = args.configured.workers.filter(|&n| n > 1 && config.run.deterministic) {
        return Err(wrong_use(format!(
            "--workers {workers}: a deterministic run has exactly one worker; remove --workers or \
             run.deterministic"
        )));
    }
    Ok(())
}

fn flags(args: &TrainArgs) -> anyhow::Result<[Option<Flag>; 8]> {
    let number = |value: Option<f64>| value.map(Value::Float);
    Ok([
        flag("--demos", "demonstrations.files", paths("--demos", &args.demos)?),
        flag("--steps", "run.steps", args.steps.map(Value::Integer)),
        flag("--deterministic", "run.deterministic", args.deterministic.then_some(true.into())),
        flag("--device", "learner.device", args.device.clone().map(Value::String)),
        flag(
            "--threads",
            "learner.threads",
            args.threads.map(|count| Value::Integer(count.into())),
        ),
        flag("--until-return", "run.until_return", number(args.until_return)),
        flag("--until-success", "run.until_success", number(args.until_success)),
        flag("--max-minutes", "run.max_minutes", number(args.max_minutes)),
    ])
}

/// Returns the path of a run's best policy, or of the given policy file.
fn policy_file(path: &Path) -> anyhow::Result<PathBuf> {
    let file = if path.is_dir() || Zoo::name(path).is_some() {
        open_run(path)?.choose_policy(PolicyChoice::Best)?.path
    } else if path.is_file() {
        path.to_owned()
    } else {
        return Err(wrong_use(format!(
            "--init-from {}: expected a run directory, zoo:TASK or a policy file",
            path.display()
        )));
    };
    if !is_safetensors(&file).unwrap_or(false) {
        return Err(wrong_use(format!(
            "--init-from {}: not a readable policy file",
            file.display()
        )));
    }
    std::fs::canonicalize(&file).with_context(|| format!("cannot resolve {}", file.display()))
}

/// Returns whether the file starts like a safetensors file: 8 bytes with the header's length, then
/// the header in JSON. The learner reads the rest once the environment has reported its sizes.
fn is_safetensors(path: &Path) -> std::io::Result<bool> {
    let mut head = [0; 9];
    let mut file = std::fs::File::open(path)?;
    let bytes = file.metadata()?.len();
    file.read_exact(&mut head)?;
    let [a, b, c, d, e, f, g, h, brace] = head;
    let header = u64::from_le_bytes([a, b, c, d, e, f, g, h]);
    Ok(header.checked_add(8).is_some_and(|end| end <= bytes) && brace == b'{')
}

fn default_path(config: &ExperimentConfig) -> anyhow::Result<PathBuf> {
    let (algorithm, policy) = (config.algorithm.name.name(), config.policy.kind.name());
    let seed = config.run.seed;
    let task = safe_name(&config.task.name);
    let name = format!("{task}-{algorithm}-{policy}-s{seed}-{}", compact(SystemTime::now()));
    let candidates = (1..=SAME_SECOND_MAX).map(|number| match number {
        1 => Path::new("runs").join(&name),
        _ => Path::new("runs").join(format!("{name}-{number}")),
    });
    candidates
        .into_iter()
        .find(|path| !path.exists())
        .with_context(|| format!("{SAME_SECOND_MAX} runs named {name} exist; use --run-dir"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_ends_within_its_warm_up_is_noted() {
        let mut config = ExperimentConfig::default();
        config.run.steps = config.exploration.warm_up_steps;
        let note = only_warms_up(&config).unwrap();
        assert!(note.contains("will not be updated") && note.contains("warm_up_steps"), "{note}");
        config.run.steps += 1;
        assert_eq!(only_warms_up(&config), None);
    }
}
