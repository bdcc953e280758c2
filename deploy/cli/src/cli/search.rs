//! `dmprl sweep` with a file that has `[search]`.

use anyhow::{Context, bail};
use dmprl_run::failure::{Outcome, wrong_use};
use dmprl_run::format::shown;
use dmprl_run::sweep_files::{Ledger, Search, SweepFile};
use dmprl_run::sweep_files::{Study, TUNING_SEED, Trial};
use dmprl_sweep::Site;
use dmprl_sweep::search::{SearchSweep, search as run_search};

use super::sweep::{SweepArgs, jobs, take};
use super::{emit, prepare_python_with, train_configuration};
use crate::terminal::{TerminalProgress, say};

/// Extra of the Python package with Optuna.
const EXTRA: &str = "search";

pub(super) fn run(
    args: &SweepArgs,
    file: &SweepFile,
    search: &Search,
    mut site: Site,
) -> anyhow::Result<Outcome> {
    let studies = Study::all(file, search, train_configuration)
        .map_err(|error| wrong_use(format!("sweep file {}: {error}", args.file.display())))?;
    let jobs = jobs(args, studies.iter().map(|study| &study.base));
    if args.dry_run {
        let mut studies = studies;
        for study in &mut studies {
            study.read_trials(search, &site.output)?;
        }
        let listing = Listing { site: &site, search, studies: &studies, jobs };
        return listing.print(args).map(|()| Outcome::Done);
    }
    let lock = take(&mut site)?;
    let (_, python) = prepare_python_with(EXTRA)
        .with_context(|| format!("{}: [search] needs Optuna", args.file.display()))?;
    let count = studies.len() * search.trials as usize;
    say(&format!("{count} trials in {}, {jobs} at once", shown(&site.output)));
    let ledger = Ledger::open(&site.output)?;
    let (search, configure) = (search.clone(), train_configuration);
    let mut sweep = SearchSweep { site, search, studies, jobs, ledger, python, configure };
    let ended = run_search(&mut sweep, &TerminalProgress::default())?;
    drop(lock);
    let SearchSweep { site, search, studies, .. } = &sweep;
    let listing = Listing { site, search, studies, jobs };
    listing.print(args)?;
    let again = format!("dmprl sweep {}", args.file.display());
    if let Some(reason) = ended.gave_up {
        bail!("{reason}\nresume with: {again}");
    }
    if ended.interrupted {
        say(&format!("resume with: {again}"));
        return Ok(Outcome::Interrupted);
    }
    if let Some(study) = studies.iter().find(|study| study.best().is_none()) {
        bail!("{}: no trial has finished, see above", study.title());
    }
    Ok(Outcome::Done)
}

/// Prints a search's space, trials and best values.
struct Listing<'a> {
    site: &'a Site,
    search: &'a Search,
    studies: &'a [Study],
    jobs: usize,
}

impl Listing<'_> {
    fn print(&self, args: &SweepArgs) -> anyhow::Result<()> {
        if args.json { emit(&self.json().to_string()) } else { emit(&self.text()) }
    }

    fn text(&self) -> String {
        let Search { trials, objective, sampler, pruner, seed, .. } = self.search;
        let mut lines = vec![format!(
            "  {trials} trials for each task and method, maximising {}; sampler {}, seed {seed}; \
             pruner {}",
            objective.name(),
            word(sampler),
            word(pruner),
        )];
        for parameter in &self.search.space {
            lines.push(format!("    {:<36} {}", parameter.key, parameter.domain.words()));
        }
        for study in self.studies {
            let base = &study.base;
            lines.push(format!(
                "  {}: {} of {trials} trials started, each {} steps with {}; evaluated on seeds \
                 from {}",
                study.title(),
                study.trials.len(),
                base.run.steps,
                plural(study.seeds.len(), "seed", "seeds"),
                base.evaluation.first_seed
            ));
            lines.extend(study.trials.iter().map(|trial| self.line(trial)));
            lines.extend(self.best(study));
        }
        lines.join("\n")
    }

    fn line(&self, trial: &Trial) -> String {
        let objective = trial.objective.map(|objective| format!("{objective:.4}"));
        format!(
            "    {:<9} {:>10}  trial {:<4} {}",
            trial.state.name(),
            objective.unwrap_or_default(),
            trial.number,
            trial.point().join(" ")
        )
    }

    fn best(&self, study: &Study) -> Vec<String> {
        let Some(best) = study.best() else { return Vec::new() };
        vec![
            format!(
                "  best of {}: trial {}, {} {:.4}",
                study.title(),
                best.number,
                self.search.objective.name(),
                best.objective.unwrap_or(f64::NAN)
            ),
            format!("    {}", best.set_line()),
            format!(
                "    dmprl train {} --config {}",
                study.task,
                shown(&study.best_path(&self.site.output))
            ),
        ]
    }

    fn json(&self) -> serde_json::Value {
        let space = self.search.space.iter().map(|parameter| {
            serde_json::json!({ "key": parameter.key, "values": parameter.domain.words() })
        });
        let trials = self.studies.iter().flat_map(|study| {
            study.trials.iter().map(move |trial| {
                let runs = study.seeds.iter().map(|&seed| study.run(trial, seed).directory);
                let runs: Vec<_> = runs
                    .map(|run| self.site.output.join(run))
                    .filter(|run| run.join("manifest.json").is_file())
                    .collect();
                serde_json::json!({
                    "task": study.task, "method": study.method, "trial": trial.number,
                    "state": trial.state, "objective": trial.objective,
                    "values": trial.json_values(), "runs": runs,
                })
            })
        });
        let best = self.studies.iter().filter_map(|study| {
            study.best().map(|best| {
                serde_json::json!({
                    "task": study.task, "method": study.method, "trial": best.number,
                    "objective": best.objective, "set": best.set_line(),
                    "config": study.best_path(&self.site.output),
                })
            })
        });
        serde_json::json!({
            "search": {
                "trials": self.search.trials, "objective": self.search.objective,
                "sampler": self.search.sampler, "pruner": self.search.pruner,
                "seed": self.search.seed, "space": space.collect::<Vec<_>>(),
            },
            "trials": trials.collect::<Vec<_>>(), "best": best.collect::<Vec<_>>(),
            "first_seed": TUNING_SEED, "jobs": self.jobs,
        })
    }
}

fn plural(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

/// A value as written in the sweep file.
fn word(value: &impl serde::Serialize) -> String {
    let json = serde_json::to_value(value).unwrap_or_default();
    json.as_str().unwrap_or_default().to_owned()
}
