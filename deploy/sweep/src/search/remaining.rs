//! Estimates the remaining time of a search.

use std::time::Duration;

use dmprl_run::sweep_files::PlannedRun;
use dmprl_run::sweep_files::Study;

use super::runner::{Place, Runner};

impl Runner<'_> {
    /// Counts an ended trial.
    pub(super) fn count(&mut self) {
        let remaining = self.remaining();
        self.progress.ended(remaining);
    }

    /// Estimates the remaining time. Running trials are assumed to finish, later ones to take as
    /// long as the average ended trial, including pruned ones.
    pub(super) fn remaining(&self) -> Option<Duration> {
        let mut estimate = self.estimate.clone();
        let mut left = Vec::new();
        for job in &self.jobs {
            let reached = self.sweep.site.reached(&job.run).max(job.process.env_steps);
            let (steps, seconds) = job.process.measured(reached);
            estimate.add(kind(&job.run), steps, seconds);
            if !job.given_up {
                let study = &self.sweep.studies[job.place.0];
                let done = study.base.run.steps.saturating_mul(job.seed as u64) + reached;
                left.push((kind(&job.run), study.trial_steps().saturating_sub(done)));
            }
        }
        for &place in &self.open {
            let study = &self.sweep.studies[place.0];
            let steps = study.trial_steps().saturating_sub(self.stepped(place));
            left.push((study_kind(study), steps));
        }
        for (study, ended) in self.sweep.studies.iter().zip(&self.ended) {
            let mean = ended.env_steps.checked_div(ended.trials);
            let mean = mean.unwrap_or_else(|| study.trial_steps());
            let to_come = (self.sweep.search.trials as usize).saturating_sub(study.trials.len());
            left.extend(std::iter::repeat_n((study_kind(study), mean), to_come));
        }
        estimate.remaining(left, self.sweep.jobs)
    }

    /// Measures a trial that ended without an error.
    pub(super) fn measure_trial(&mut self, place: Place) {
        let env_steps = self.stepped(place);
        let ended = &mut self.ended[place.0];
        ended.trials += 1;
        ended.env_steps += env_steps;
    }

    /// Environment steps of a trial's runs so far.
    fn stepped(&self, place: Place) -> u64 {
        let (study, trial) = self.at(place);
        study.seeds.iter().map(|&seed| self.sweep.site.reached(&study.run(trial, seed))).sum()
    }
}

/// Number and environment steps of a study's ended trials.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Ended {
    trials: u64,
    env_steps: u64,
}

pub(super) fn kind(run: &PlannedRun) -> (&str, &str) {
    (&run.task, &run.method)
}

fn study_kind(study: &Study) -> (&str, &str) {
    (&study.task, &study.method)
}
