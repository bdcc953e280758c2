//! `dmprl clean`: what dead runs have left in shared memory, removed.

use clap::Args;

use super::emit;
use crate::failure::Outcome;
use crate::launch::Place;
use crate::terminal::binary_bytes;

const HELP: &str = "\
A run that was killed leaves its shared memory behind. Removed is what has dmprl's marker, belongs
to you, and whose supervisor and learner are dead: a live run holds a lock on its own. The next
`train` does the same; run directories and checkpoints are never touched.

EXAMPLES
  dmprl clean --dry-run    # only say what there is
  dmprl clean";

/// Arguments of `dmprl clean`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct CleanArgs {
    /// Remove nothing, only list.
    #[arg(long)]
    dry_run: bool,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &CleanArgs) -> anyhow::Result<Outcome> {
    let place = Place::new();
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
        (0, _) => format!("dead runs have left nothing in {}", place.base().display()),
        (count, true) => format!("{} of {count} dead runs to remove", binary_bytes(bytes)),
        (count, false) => format!("{} of {count} dead runs removed", binary_bytes(bytes)),
    });
    emit(&lines.join("\n"))?;
    Ok(Outcome::Done)
}
