//! `dmprl report`: compares runs and sweeps.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::Context;
use clap::Args;
use dmprl_analysis::report::{
    PlannedFilmstrip, Report, Results, curves, efficiency, evaluate_statements, measure_motions,
    missing_filmstrips, missing_trajectories, needs_recording, pareto, plan_filmstrips,
    read_filmstrips, record_filmstrips, tables, trajectories, unmeasured,
};
use dmprl_run::failure::Outcome;
use dmprl_run::format::shown;
use dmprl_run::{PolicyChoice, Progress, RunDirectory, rfc3339};
use dmprl_sweep::record::{Observer, RecordPlan, measure_motion, record};

use super::trust::TrustArgs;
use super::{emit, prepare_python, prepare_python_with, this_program};
use crate::terminal::{TerminalProgress, say};

/// Maximum number of methods that a title lists.
const TITLE_METHODS_MAX: usize = 5;

const HELP: &str = "\
Writes index.html (one self-contained page), report.md, figures.csv, runs.csv, report-data.json and
every picture as SVG and PNG. Each table and figure begins with its finding in a sentence. Tables
show mean and standard deviation over seeds, and with four or more seeds the interquartile mean with
a 95 % interval by stratified bootstrap (Agarwal et al. 2021). On the paper's tasks they also show
the paper's figures. Only finished runs count. Figures over runs of different programs or package
versions are marked.
Motion is measured once per run, by rolling out its last policy, and kept in the run directory. The
frames of a rollout are also recorded once; they need an environment that can render.
The folder of an earlier report can replace run directories that are elsewhere or deleted: its runs
count unless a given run or sweep has a finished run of the same task, method and seed. It may also
be the output folder.

EXAMPLES
  dmprl report runs/paper
  dmprl report runs/reacher-s1 runs/reacher-s2 runs/reacher-s3 --output report
  dmprl report runs/paper reports/of-another-machine --output reports/both
  dmprl report runs/smoothness --pareto
  dmprl report runs/paper --no-motion --json";

/// Arguments of `dmprl report`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub(super) struct ReportArgs {
    /// Run directories, directories of sweeps, and folders of earlier reports.
    #[arg(required = true, value_name = "RUN|SWEEP|REPORT")]
    runs: Vec<PathBuf>,
    /// Output folder [default: SWEEP/report for one sweep, else report].
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Do not roll policies out; show only motion and frames that exist already.
    #[arg(long)]
    no_motion: bool,
    /// Also draw return against smoothness, a point for each method, with the Pareto front.
    #[arg(long)]
    pareto: bool,
    #[command(flatten)]
    trust: TrustArgs,
    /// Also print the tables as one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &ReportArgs) -> anyhow::Result<Outcome> {
    let mut results = Results::read(&args.runs)?;
    if !args.no_motion && measure(&mut results, args.trust)? == Outcome::Interrupted {
        return Ok(Outcome::Interrupted);
    }
    let filmstrips = plan_filmstrips(&results)?;
    if !args.no_motion && draw(&filmstrips, &mut results, args.trust)? == Outcome::Interrupted {
        return Ok(Outcome::Interrupted);
    }
    results.undrawn.extend(missing_filmstrips(&filmstrips));
    results.undrawn.extend(missing_trajectories(&results));
    let pareto = if args.pareto { pareto(&results)? } else { Vec::new() };
    if args.pareto && pareto.is_empty() {
        let reason = "return against smoothness: it needs two methods with finished runs of a task";
        results.undrawn.push(reason.to_owned());
    }
    for reason in &results.unmeasured {
        say(&format!("motion not measured: {reason}"));
    }
    for reason in &results.undrawn {
        say(&format!("not drawn: {reason}"));
    }
    let in_sweep = |path: &PathBuf| path.join("sweep.toml").is_file().then(|| path.join("report"));
    let output = match (&args.output, args.runs.as_slice()) {
        (Some(output), _) => output.clone(),
        (None, [one]) => in_sweep(one).unwrap_or_else(|| PathBuf::from("report")),
        (None, _) => PathBuf::from("report"),
    };
    let tables = tables(&results);
    let (efficiency, claims) = (efficiency(&results), evaluate_statements(&results)?);
    let json = serde_json::json!({
        "methods": results.methods,
        "tables": tables,
        "efficiency": efficiency,
        "statements": claims.results,
    });
    let names: Vec<_> = args.runs.iter().map(|path| path.display().to_string()).collect();
    let report = Report {
        title: title(&results),
        command: format!(
            "dmprl report {}{}",
            names.join(" "),
            if args.pareto { " --pareto" } else { "" }
        ),
        made: rfc3339(SystemTime::now()),
        commit: dmprl_run::project::git_commit(),
        curves: curves(&results)?,
        pareto,
        filmstrips: read_filmstrips(&filmstrips)?,
        trajectories: trajectories(&results)?,
        results,
        tables,
        efficiency,
        claims,
    };
    report
        .write(&output)
        .with_context(|| format!("cannot write the report into {}", output.display()))?;
    if args.json {
        emit(&json.to_string())?;
    }
    say(&format!("written: {}", shown(&output.join("index.html"))));
    Ok(Outcome::Done)
}

fn title(results: &Results) -> String {
    match (results.tasks.as_slice(), results.methods.as_slice()) {
        ([task], methods) if methods.len() <= TITLE_METHODS_MAX => {
            format!("{task}: {}", methods.join(", "))
        }
        ([task], methods) => format!("{} methods on {task}", methods.len()),
        (tasks, [method]) => format!("{method} on {} tasks", tasks.len()),
        (tasks, methods) => format!("{} methods on {} tasks", methods.len(), tasks.len()),
    }
}

/// Measures the motion of runs that have no measurement yet. Skips it if Python is unavailable.
fn measure(results: &mut Results, trust: TrustArgs) -> anyhow::Result<Outcome> {
    let count = unmeasured(results);
    if count == 0 {
        return Ok(Outcome::Done);
    }
    let venv = match prepare_python() {
        Ok(venv) => venv,
        Err(error) => {
            results.unmeasured.push(format!("all runs: {error:#}"));
            return Ok(Outcome::Done);
        }
    };
    let observer = Observer { program: this_program()?, venv };
    let progress = TerminalProgress::default();
    Ok(measure_motions(results, |run| {
        trust.check(run.directory)?;
        progress.at(run.index, count as u64);
        let (number, name) = (run.index + 1, run.name);
        progress.state(&format!("measuring motion {number} of {count}: {name}"));
        measure_motion(run.directory, &observer)
    }))
}

/// Records the frames that do not exist yet. Skips them if Python is unavailable.
fn draw(
    filmstrips: &[PlannedFilmstrip],
    results: &mut Results,
    trust: TrustArgs,
) -> anyhow::Result<Outcome> {
    if !needs_recording(filmstrips) {
        return Ok(Outcome::Done);
    }
    let (venv, python) = match prepare_python_with("video") {
        Ok(prepared) => prepared,
        Err(error) => {
            results.undrawn.push(format!("frames: {error:#}"));
            return Ok(Outcome::Done);
        }
    };
    let observer = Observer { program: this_program()?, venv };
    let progress = TerminalProgress::default();
    Ok(record_filmstrips(filmstrips, &mut results.undrawn, |run| {
        trust.check(run)?;
        let plan = first_episode(run, &observer, &python)?;
        let made = record(&plan, &progress)?;
        Ok(made.map_or(Outcome::Interrupted, |_| Outcome::Done))
    }))
}

/// Plans the recording of the first evaluation episode of a run's latest policy.
fn first_episode<'r>(
    run: &'r RunDirectory,
    observer: &Observer,
    python: &Path,
) -> anyhow::Result<RecordPlan<'r>> {
    Ok(RecordPlan {
        sides: vec![(run, run.choose_policy(PolicyChoice::Latest)?)],
        first_seed: run.config()?.evaluation.first_seed,
        episodes: 1,
        output: run.path().join("videos"),
        observer: observer.clone(),
        python: python.to_owned(),
        rerun: false,
    })
}
