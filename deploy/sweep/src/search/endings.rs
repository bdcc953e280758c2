//! Ends trials and their runs, and reports the results.

use anyhow::Context;
use dmprl_run::sweep_files::Study;
use dmprl_run::sweep_files::TrialState;
use dmprl_run::sweep_files::{End, Finished, PlannedRun};
use dmprl_shared::supervision::EvaluationRow;

use super::runner::{Runner, TrialId};
use crate::run::evaluation_text;

/// Number of consecutive failed trials after which the search stops. So many failures hardly come
/// from the suggested values.
const FAILED_IN_A_ROW_MAX: u32 = 5;

impl Runner<'_> {
    /// Adds a run to the ledger; returns its last evaluation.
    pub(super) fn add_to_ledger(
        &mut self,
        run: &PlannedRun,
        study: &Study,
        state: End,
    ) -> anyhow::Result<Option<EvaluationRow>> {
        let (wall_s, row) = self.sweep.site.final_result(run)?;
        if row.is_none() && state.is_finished() {
            return Ok(None);
        }
        let steps = study.base.run.steps;
        let env_steps = match &row {
            Some(row) if state.is_finished() => row.env_steps,
            _ => self.sweep.site.measured_steps(run),
        };
        let directory = run.directory.clone();
        let finished = Finished { run: directory, steps, env_steps, wall_s, state };
        self.sweep.ledger.add(finished)?;
        Ok(row)
    }

    /// Ends a trial as finished after all of its runs have.
    pub(super) async fn finish(&mut self, id: TrialId) -> anyhow::Result<()> {
        let (study, trial) = self.study_and_trial(id);
        let mut sum = 0.0;
        for &seed in &study.seeds {
            let (_, row) = self.sweep.site.final_result(&study.run(trial, seed))?;
            let row = row.with_context(|| format!("seed {seed} has no evaluation"))?;
            sum += self.measure(study, &row)?;
        }
        let mean = sum / study.seeds.len() as f64;
        self.end(id, TrialState::Finished, Some(mean)).await?;
        self.write_best(id.study)?;
        let (study, trial) = self.study_and_trial(id);
        let objective = self.sweep.search.objective.name();
        let best = study.best().filter(|best| best.number != trial.number);
        let best = best.map_or_else(
            || "the best so far".to_owned(),
            |best| {
                format!(
                    "the best is trial {} with {:.4}",
                    best.number,
                    best.objective.unwrap_or(mean)
                )
            },
        );
        let title = format!("{} · trial {}", study.title(), trial.number);
        self.progress.message(&format!("{title}: {objective} {mean:.4}, {best}"));
        self.count_ended();
        Ok(())
    }

    /// Ends a trial as pruned.
    pub(super) async fn prune(
        &mut self,
        id: TrialId,
        run: &PlannedRun,
        row: Option<&EvaluationRow>,
    ) -> anyhow::Result<()> {
        self.end(id, TrialState::Pruned, None).await?;
        let at =
            row.map(|row| format!(" at {} steps with {}", row.env_steps, evaluation_text(row)));
        self.progress.message(&format!("{}: pruned{}", run.title(), at.unwrap_or_default()));
        self.failed_in_a_row = 0;
        self.count_ended();
        Ok(())
    }

    /// Ends a trial as failed, and stops the search after too many consecutive failures.
    pub(super) async fn fail(
        &mut self,
        id: TrialId,
        run: &PlannedRun,
        reason: String,
    ) -> anyhow::Result<()> {
        self.end(id, TrialState::Failed, None).await?;
        self.progress.message(&format!("{}: failed: {reason}", run.title()));
        self.count_ended();
        self.failed_in_a_row += 1;
        if self.failed_in_a_row >= FAILED_IN_A_ROW_MAX && self.gave_up.is_none() {
            self.gave_up = Some(format!(
                "{FAILED_IN_A_ROW_MAX} trials in a row have failed; the last error: {reason}"
            ));
            self.interrupts += 1;
            for job in &self.jobs {
                job.process.interrupt();
            }
        }
        Ok(())
    }

    /// Ends a trial, first in the storage, which is authoritative.
    pub(super) async fn end(
        &mut self,
        id: TrialId,
        state: TrialState,
        objective: Option<f64>,
    ) -> anyhow::Result<()> {
        let (study, trial) = self.study_and_trial(id);
        let (name, number) = (study.name(), trial.number);
        self.optuna.tell(&name, number, state, objective).await?;
        let trial = &mut self.sweep.studies[id.study].trials[id.trial];
        (trial.state, trial.objective) = (state, objective);
        if state != TrialState::Failed {
            self.add_trial_steps(id);
        }
        self.write_trial(id)
    }
}
