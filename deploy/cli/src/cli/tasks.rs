//! `dmprl tasks`: lists the built-in tasks.

use clap::Args;
use dmprl_run::failure::Outcome;
use dmprl_shared::config::{TASKS, TaskDefaults};

use super::emit;

const HELP: &str = "\
Every Gymnasium environment with box-shaped observations and actions is also a task, by its id.

EXAMPLES
  dmprl tasks
  dmprl tasks --json
  dmprl train Pendulum-v1
  dmprl train my_module:MyArm-v0 --python-path ./envs";

const OTHERS: &str = "\
Other Gymnasium ids work too, such as Pendulum-v1; my_module:MyArm-v0 imports my_module first.";

/// Arguments of `dmprl tasks`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct TasksArgs {
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &TasksArgs) -> anyhow::Result<Outcome> {
    if args.json {
        emit(&serde_json::json!({ "tasks": TASKS }).to_string())?;
        return Ok(Outcome::Done);
    }
    let tasks: Vec<String> = TASKS.iter().map(description).collect();
    emit(&format!("{}\n{OTHERS}", tasks.join("\n")))?;
    Ok(Outcome::Done)
}

fn description(task: &TaskDefaults) -> String {
    let TaskDefaults { name, id, about, control, source, .. } = task;
    let TaskDefaults { observation_len, action_low, episode_steps, control_dt_s, .. } = task;
    let action_len = action_low.len();
    let seconds = f64::from(*episode_steps) * control_dt_s;
    format!(
        "{name:27} {about}\n{:27} {id}, from {source}\n{:27} observation {observation_len}, \
         action {action_len}: {control}\n{:27} episode {episode_steps} steps of {control_dt_s} s, \
         {seconds:.0} s\n",
        "", "", ""
    )
}
