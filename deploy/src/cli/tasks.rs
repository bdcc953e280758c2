//! `dmprl tasks`.

use clap::Args;
use dmprl_shared::config::{Layers, TASKS};
use serde::Serialize;

use super::emit;
use crate::failure::Outcome;

const HELP: &str = "\
Every Gymnasium id with box-shaped observations and actions is a task too.

EXAMPLES
  dmprl tasks
  dmprl tasks --json
  dmprl train Pendulum-v1
  dmprl train my_module:MyArm-v0 --python-path ./envs";

/// Arguments of `dmprl tasks`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct TasksArgs {
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Task {
    name: &'static str,
    id: String,
    about: &'static str,
    steps: u64,
}

pub(super) fn run(args: &TasksArgs) -> anyhow::Result<Outcome> {
    let mut tasks = Vec::new();
    for task in &TASKS {
        let mut layers = Layers::new();
        layers.add(task.name, task.table())?;
        let config = layers.finish()?;
        let steps = config.run.steps;
        tasks.push(Task { name: task.name, id: config.task.id, about: task.about, steps });
    }
    if args.json {
        emit(&serde_json::json!({ "tasks": tasks }).to_string())?;
        return Ok(Outcome::Done);
    }
    let width = |of: fn(&Task) -> usize| tasks.iter().map(of).max().unwrap_or(0);
    let (name, id) = (width(|task| task.name.len()), width(|task| task.id.len()));
    let lines = tasks.iter().map(|task| {
        format!("{:name$}  {:id$}  {:>9} steps  {}", task.name, task.id, task.steps, task.about)
    });
    let mut text = lines.collect::<Vec<_>>().join("\n");
    text.push_str(
        "\n\nAny other Gymnasium id works too, such as Pendulum-v1 or my_module:MyArm-v0.",
    );
    emit(&text)?;
    Ok(Outcome::Done)
}
