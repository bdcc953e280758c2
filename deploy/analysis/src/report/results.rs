//! The runs that a report compares.

use plotters::style::RGBColor;

use super::families;
use super::measures::Measure;
use super::motion_metrics::Rollout;
use super::run::{Run, RunKey};
use super::statistics::Summary;
use crate::plots::palette;

/// Maximum number of methods in a picture, if some of them differ only in values of a sweep's grid.
const SHOWN_MAX: usize = 8;

/// The runs of a report. Tasks and methods are in the order of the command line.
#[derive(Debug, Clone, Default)]
pub struct Results {
    /// Rows of the tables.
    pub tasks: Vec<String>,
    /// Columns of the tables.
    pub methods: Vec<String>,
    /// Runs that have started.
    pub runs: Vec<Run>,
    /// Planned runs that have not started.
    pub not_started: Vec<RunKey>,
    /// Name of each sweep's directory, and the text of its sweep file.
    pub sweeps: Vec<(String, String)>,
    /// Runs whose motion could not be measured, with the reason.
    pub unmeasured: Vec<String>,
    /// Pictures that could not be drawn, with the reason.
    pub undrawn: Vec<String>,
}

/// The rollout that represents a method in the pictures of a task.
pub(super) struct ShownRollout<'r> {
    /// Index of the method in the report.
    pub(super) method_index: usize,
    pub(super) run: &'r Run,
    pub(super) rollout: &'r Rollout,
}

impl Results {
    /// Returns the runs of a task with a method.
    pub fn of<'a>(
        &'a self,
        task: &'a str,
        method: &'a str,
    ) -> impl Iterator<Item = &'a Run> + Clone {
        self.runs.iter().filter(move |run| run.task == task && run.method == method)
    }

    /// Returns the colours of the methods in the pictures of a task.
    pub(super) fn colours(&self) -> Vec<RGBColor> {
        let names = families::names(&self.methods);
        if !self.shows_best_settings() {
            return palette(&self.methods.iter().map(String::as_str).collect::<Vec<_>>());
        }
        let colours = palette(&names);
        let of = |label| names.iter().position(|name| *name == families::split(label).0);
        self.methods.iter().map(|label| colours[of(label).unwrap_or(0)]).collect()
    }

    /// Returns true if pictures of single methods show only the best of those that differ in values
    /// of a sweep's grid.
    pub(super) fn shows_best_settings(&self) -> bool {
        let is_grid = families::names(&self.methods).len() < self.methods.len();
        is_grid && self.methods.len() > SHOWN_MAX
    }

    /// Returns the indices of the methods in the pictures of a task.
    pub(super) fn shown_methods(&self, task: &str) -> Vec<usize> {
        if !self.shows_best_settings() {
            return (0..self.methods.len()).collect();
        }
        let name = |index: usize| families::split(&self.methods[index]).0;
        let best_of = |of: &str| {
            let has_run = |index: usize| self.of(task, &self.methods[index]).next().is_some();
            let settings =
                (0..self.methods.len()).filter(|index| name(*index) == of && has_run(*index));
            // While no run is finished, any setting is as good as another.
            let worst = (0.0, f64::NEG_INFINITY);
            let scored = settings
                .map(|index| (self.score(task, &self.methods[index]).unwrap_or(worst), index));
            // Of equal ones the first.
            scored.rev().max_by(|(a, _), (b, _)| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)))
        };
        let names = families::names(&self.methods);
        names.into_iter().filter_map(best_of).map(|(_, index)| index).collect()
    }

    /// Returns a method's mean success rate, 0 if unknown, and mean return; `None` without a
    /// finished run. Methods are compared by the first, then by the second.
    pub(super) fn score(&self, task: &str, method: &str) -> Option<(f64, f64)> {
        let mean = |measure: Measure| {
            let scores: Vec<f64> =
                self.of(task, method).filter_map(|run| measure.of(run)).collect();
            Summary::of(&scores).map(|summary| summary.mean)
        };
        Some((mean(Measure::Success).unwrap_or(0.0), mean(Measure::Return)?))
    }

    /// Returns the rollout of each shown method's lowest seed that has one. All have the same
    /// episode and robot as that of the first method.
    pub(super) fn shown_rollouts<'r>(&'r self, task: &'r str) -> Vec<ShownRollout<'r>> {
        let mut shown: Vec<ShownRollout<'r>> = Vec::new();
        for method_index in self.shown_methods(task) {
            let mut runs: Vec<&Run> = self.of(task, &self.methods[method_index]).collect();
            runs.sort_by_key(|run| run.seed);
            let recorded = runs.into_iter().find_map(|run| {
                let rollout = run.motion.as_ref()?.rollout.as_ref()?;
                let is_comparable =
                    shown.first().is_none_or(|first| first.rollout.is_comparable(rollout));
                is_comparable.then_some((run, rollout))
            });
            shown.extend(recorded.map(|(run, rollout)| ShownRollout {
                method_index,
                run,
                rollout,
            }));
        }
        shown
    }

    /// Returns true if the run's rollout represents its method in the pictures.
    pub(super) fn is_shown(&self, run: &Run) -> bool {
        self.shown_rollouts(&run.task).iter().any(|shown| std::ptr::eq(shown.run, run))
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};

    #[test]
    fn pictures_of_a_large_grid_show_the_best_setting_of_each_method() {
        let labels: Vec<String> = ["TD3", "SAC"]
            .iter()
            .flat_map(|name| (1..=5).map(move |value| format!("{name}, algorithm.tau={value}")))
            .collect();
        let run = |(index, label): (usize, &'static str)| FixtureRun {
            task: "pusher-v0",
            method: label,
            seed: 1,
            rows: vec![[-9.0, -5.0, -4.0, -4.0, -7.0][index % 5]],
            ended: true,
        };
        let labels = labels.into_iter().map(|label| &*label.leak());
        let results = fixture_results(&labels.enumerate().map(run).collect::<Vec<_>>());
        assert_eq!(results.shown_methods("pusher-v0"), [2, 7]);
        assert!(results.shown_methods("reacher-v1").is_empty(), "no run");
        let colours = results.colours();
        assert!(colours[0] == colours[4] && colours[4] != colours[5]);
        let mut unfinished = results.clone();
        unfinished.runs.iter_mut().for_each(|run| run.ended = false);
        assert_eq!(unfinished.shown_methods("pusher-v0"), [0, 5]);
        let mut few = results;
        few.methods.truncate(8);
        assert_eq!(few.shown_methods("pusher-v0"), [0, 1, 2, 3, 4, 5, 6, 7]);
    }
}
