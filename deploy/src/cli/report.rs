//! `dmprl report`: runs and sweeps side by side.

use std::path::PathBuf;
use std::time::SystemTime;

use anyhow::Context;
use clap::Args;

use super::{emit, prepare_python, prepare_python_with, this_program};
use crate::failure::Outcome;
use crate::motion::Means;
use crate::report::{
    Report, Results, Wanted, curves, draw, efficiency, judge, lost_strips, lost_trajectories,
    measure_motions, strips, tables, trajectories, undrawn, unmeasured, wanted,
};
use crate::run_directory::rfc3339;
use crate::terminal::{say, shown};

const HELP: &str = "\
Writes index.html (one page that needs nothing else), report.md, figures.csv, runs.csv, curves.json
and every picture as SVG and PNG. Tables give mean and standard deviation over seeds, and from four
seeds on the interquartile mean with a 95 % interval by stratified bootstrap (Agarwal et al. 2021);
below four seeds they give the range. The paper's figures stand beside them for its own tasks and
methods. Only finished runs count. Figures over runs of different programs or package versions are
marked.
Motion is measured once per run, by rolling out its last policy, and kept in the run directory. So
are the frames of a rollout, which need an environment that can render.
The folder of an earlier report replaces runs that are elsewhere or deleted: its runs count where
no given run or sweep has a finished run of the same task, method and seed. It may be the output
folder itself.

EXAMPLES
  dmprl report runs/paper
  dmprl report runs/reacher-s1 runs/reacher-s2 runs/reacher-s3 --output report
  dmprl report runs/paper reports/of-another-machine --output reports/both
  dmprl report runs/paper --no-motion --json";

/// Arguments of `dmprl report`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ReportArgs {
    /// Run directories, directories of sweeps, and folders of earlier reports.
    #[arg(required = true, value_name = "RUN|SWEEP|REPORT")]
    runs: Vec<PathBuf>,
    /// Where the report goes [default: SWEEP/report for one sweep, else report].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Roll nothing out; what was measured and drawn before is shown.
    #[arg(long)]
    no_motion: bool,
    /// Print the tables as one JSON object on standard output, too.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &ReportArgs) -> anyhow::Result<Outcome> {
    let mut results = Results::read(&args.runs)?;
    if !args.no_motion && measure(&mut results)? == Outcome::Interrupted {
        return Ok(Outcome::Interrupted);
    }
    let wanted = wanted(&results)?;
    if !args.no_motion && drawn(&wanted, &mut results)? == Outcome::Interrupted {
        return Ok(Outcome::Interrupted);
    }
    let lost = lost_strips(&wanted).into_iter().chain(lost_trajectories(&results));
    let lost: Vec<String> = lost.collect();
    results.undrawn.extend(lost);
    for reason in &results.unmeasured {
        say(&format!("motion not measured: {reason}"));
    }
    for reason in &results.undrawn {
        say(&format!("not drawn: {reason}"));
    }
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
        strips: strips(&wanted)?,
        trajectories: trajectories(&results)?,
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

/// Rolls out what nobody has; a report without motion is better than none.
fn measure(results: &mut Results) -> anyhow::Result<Outcome> {
    if unmeasured(results) == 0 {
        return Ok(Outcome::Done);
    }
    Ok(match prepare_python() {
        Ok(venv) => measure_motions(results, &Means { program: this_program()?, venv }),
        Err(error) => {
            results.unmeasured.push(format!("all of them: {error:#}"));
            Outcome::Done
        }
    })
}

/// Draws frames that nobody has drawn; a report without pictures is better than none.
fn drawn(wanted: &[Wanted], results: &mut Results) -> anyhow::Result<Outcome> {
    if !undrawn(wanted) {
        return Ok(Outcome::Done);
    }
    Ok(match prepare_python_with("video") {
        Ok((venv, python)) => {
            let means = Means { program: this_program()?, venv };
            draw(wanted, (&means, &python), &mut results.undrawn)
        }
        Err(error) => {
            results.undrawn.push(format!("anything: {error:#}"));
            Outcome::Done
        }
    })
}
