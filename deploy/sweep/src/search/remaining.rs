//! Estimates the remaining time of a search.

use std::time::Duration;

use super::runner::{Runner, TrialId};
use crate::estimate::RunKind;

/// Number and environment steps of a study's ended trials.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct EndedTrials {
    count: u64,
    env_steps: u64,
}

impl Runner<'_> {
    /// Counts an ended trial and shows the remaining time.
    pub(super) fn count_ended(&mut self) {
        let remaining = self.remaining();
        self.progress.ended(remaining);
    }

    /// Estimates the remaining time. Running trials are assumed to finish, later ones to take as
    /// many steps as the average of the ended trials, including pruned ones.
    pub(super) fn remaining(&self) -> Option<Duration> {
        let mut estimate = self.estimate.clone();
        let mut left = Vec::new();
        for job in &self.jobs {
            let kind = RunKind::of_run(&job.run);
            let reached = self.sweep.site.measured_steps(&job.run).max(job.process.env_steps);
            let (steps, seconds) = job.process.measured(reached);
            estimate.add(kind, steps, seconds);
            if !job.pruned {
                let study = &self.sweep.studies[job.trial.study];
                let done = study.base.run.steps.saturating_mul(job.seed as u64) + reached;
                left.push((kind, study.trial_steps().saturating_sub(done)));
            }
        }
        for &id in &self.open {
            let study = &self.sweep.studies[id.study];
            let steps = study.trial_steps().saturating_sub(self.trial_steps_done(id));
            left.push((RunKind::of_study(study), steps));
        }
        for (study, ended) in self.sweep.studies.iter().zip(&self.ended) {
            let mean = ended.env_steps.checked_div(ended.count);
            let mean = mean.unwrap_or_else(|| study.trial_steps());
            let to_come = (self.sweep.search.trials as usize).saturating_sub(study.trials.len());
            left.extend(std::iter::repeat_n((RunKind::of_study(study), mean), to_come));
        }
        estimate.remaining(left, self.sweep.jobs)
    }

    /// Adds the steps of a trial that ended without an error to those of its study.
    pub(super) fn add_trial_steps(&mut self, id: TrialId) {
        let env_steps = self.trial_steps_done(id);
        let ended = &mut self.ended[id.study];
        ended.count += 1;
        ended.env_steps += env_steps;
    }

    /// Environment steps of a trial's runs so far.
    fn trial_steps_done(&self, id: TrialId) -> u64 {
        let (study, trial) = self.study_and_trial(id);
        let steps = |&seed| self.sweep.site.measured_steps(&study.run(trial, seed));
        study.seeds.iter().map(steps).sum()
    }
}
