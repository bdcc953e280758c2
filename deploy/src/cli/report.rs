//! `dmprl report`: runs and sweeps side by side.

use std::path::PathBuf;
use std::time::SystemTime;

use anyhow::Context;
use clap::Args;

use super::emit;
use crate::failure::Outcome;
use crate::report::{Report, Results, curves, efficiency, judge, tables};
use crate::run_directory::rfc3339;
use crate::terminal::{say, shown};

const HELP: &str = "\
Writes index.html (one page that needs nothing else), report.md, figures.csv, runs.csv, curves.json
and every picture as SVG and PNG. Tables give mean and standard deviation over seeds, and the interquartile mean with a
95 % interval by stratified bootstrap (Agarwal et al. 2021), beside the paper's figures where the
task and the method are the paper's. Only runs that have come to their end count in a table.

EXAMPLES
  dmprl report runs/paper
  dmprl report runs/reacher-s1 runs/reacher-s2 runs/reacher-s3 --output report
  dmprl report runs/paper --json";

/// Arguments of `dmprl report`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ReportArgs {
    /// Run directories, and directories of sweeps.
    #[arg(required = true, value_name = "RUN|SWEEP")]
    runs: Vec<PathBuf>,
    /// Where the report goes [default: SWEEP/report for one sweep, else report].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print the tables as one JSON object on standard output, too.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &ReportArgs) -> anyhow::Result<Outcome> {
    let results = Results::read(&args.runs)?;
    let of_one = |path: &PathBuf| path.join("sweep.toml").is_file().then(|| path.join("report"));
    let output = match (&args.output, args.runs.as_slice()) {
        (Some(output), _) => output.clone(),
        (None, [one]) => of_one(one).unwrap_or_else(|| PathBuf::from("report")),
        (None, _) => PathBuf::from("report"),
    };
    let tables = tables(&results);
    let (efficiency, judged) = (efficiency(&results), judge(&results));
    let json = serde_json::json!({
        "methods": results.methods,
        "tables": tables,
        "efficiency": efficiency,
        "statements": judged,
    });
    let names: Vec<_> = args.runs.iter().map(|path| path.display().to_string()).collect();
    let title = match results.tasks.as_slice() {
        [task] => format!("{task}: {}", results.methods.join(", ")),
        tasks => format!("{} methods on {} tasks", results.methods.len(), tasks.len()),
    };
    let report = Report {
        title,
        command: format!("dmprl report {}", names.join(" ")),
        made: rfc3339(SystemTime::now()),
        commit: crate::project::git_commit(),
        curves: curves(&results)?,
        results,
        tables,
        efficiency,
        judged,
    };
    report.write(&output).with_context(|| format!("no report in {}", output.display()))?;
    if args.json {
        emit(&json.to_string())?;
    }
    say(&format!("written: {}", shown(&output.join("index.html"))));
    Ok(Outcome::Done)
}
