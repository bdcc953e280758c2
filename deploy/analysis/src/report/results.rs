//! The runs that a report compares.

use plotters::style::RGBColor;

use super::motion_metrics::Rollout;
use super::run::{Run, RunKey};
use crate::plots::palette;

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

    /// Returns the colours of the methods.
    pub(super) fn colours(&self) -> Vec<RGBColor> {
        palette(&self.methods.iter().map(String::as_str).collect::<Vec<_>>())
    }

    /// Returns the rollout of each method's lowest seed that has one. All have the same episode and
    /// robot as that of the first method.
    pub(super) fn shown_rollouts<'r>(&'r self, task: &'r str) -> Vec<ShownRollout<'r>> {
        let mut shown: Vec<ShownRollout<'r>> = Vec::new();
        for (method_index, method) in self.methods.iter().enumerate() {
            let mut runs: Vec<&Run> = self.of(task, method).collect();
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
