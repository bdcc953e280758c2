//! `dmprl clean`: removes the shared memory of dead runs.

use clap::Args;
use dmprl_run::failure::Outcome;
use dmprl_run::format::binary_bytes;
use dmprl_supervisor::Place;

use super::emit;

const HELP: &str = "\
A killed run leaves its shared memory behind. Removes shared memory that has dmprl's marker and
belongs to you, if the run's supervisor and learner are dead (a live run holds a lock on it).
`train` does the same when it starts. Run directories and checkpoints are not touched.

EXAMPLES
  dmprl clean --dry-run    # only list
  dmprl clean";

/// Arguments of `dmprl clean`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct CleanArgs {
    /// List without removing.
    #[arg(long)]
    dry_run: bool,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &CleanArgs) -> anyhow::Result<Outcome> {
    let place = Place::of_this_user();
    let leftovers = if args.dry_run { place.leftovers()? } else { place.remove_leftovers()? };
    let bytes: u64 = leftovers.iter().map(|leftover| leftover.bytes).sum();
    if args.json {
        let listed: Vec<_> = leftovers
            .iter()
            .map(|leftover| serde_json::json!({ "path": leftover.path, "bytes": leftover.bytes }))
            .collect();
        let removed = !args.dry_run;
        let object = serde_json::json!({ "leftovers": listed, "bytes": bytes, "removed": removed });
        emit(&object.to_string())?;
        return Ok(Outcome::Done);
    }
    let mut lines: Vec<String> = leftovers
        .iter()
        .map(|leftover| {
            format!("  {:>10}  {}", binary_bytes(leftover.bytes), leftover.path.display())
        })
        .collect();
    lines.push(match (leftovers.len(), args.dry_run) {
        (0, _) => format!("no shared memory of dead runs in {}", place.base().display()),
        (count, true) => format!("{} of {count} dead runs to remove", binary_bytes(bytes)),
        (count, false) => format!("{} of {count} dead runs removed", binary_bytes(bytes)),
    });
    emit(&lines.join("\n"))?;
    Ok(Outcome::Done)
}
