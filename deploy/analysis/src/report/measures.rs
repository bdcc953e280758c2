//! The measures by which runs are compared, with their descriptions.

use dmprl_shared::supervision::EvaluationRow;
use serde::Deserialize;

use super::paper::PaperTable;
use super::run::Run;
use super::thresholds::threshold;

/// Groups of measures, in the order of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeasureKind {
    /// How well the policy solves the task.
    Result,
    /// How smoothly it moves.
    Smoothness,
    /// The cost of training.
    Cost,
}

/// A measure with one value per run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Mean return of the last evaluation.
    Return,
    /// Fraction of the last evaluation's episodes that end in success.
    Success,
    /// Mean absolute change of actions between two steps.
    ActionChange,
    /// Mean absolute second difference of actions.
    ActionAcceleration,
    /// Mean absolute jerk of the joints.
    JointJerk,
    /// Spectral arc length of the joints' speed.
    Sparc,
    /// Policy decisions in training, one per segment.
    Decisions,
    /// Updates of the learner.
    Updates,
    /// Wall-clock time of training \[s\].
    TrainingTime,
    /// Updates per environment step.
    UpdateRate,
    /// Environment steps until the task's threshold is reached; infinite if a finished run never
    /// reached it.
    StepsToThreshold,
}

impl Measure {
    /// Measures that have a table in the report, in its order.
    pub const TABLES: [Self; 9] = [
        Self::Return,
        Self::Success,
        Self::ActionChange,
        Self::ActionAcceleration,
        Self::JointJerk,
        Self::Sparc,
        Self::Decisions,
        Self::Updates,
        Self::TrainingTime,
    ];

    /// Returns the heading.
    #[must_use]
    pub fn title(self) -> &'static str {
        match self {
            Self::Return => "Average return",
            Self::Success => "Success rate",
            Self::ActionChange => "Smoothness: change of actions",
            Self::ActionAcceleration => "Smoothness: acceleration of actions",
            Self::JointJerk => "Smoothness: joint jerk [rad/s³]",
            Self::Sparc => "Smoothness: SPARC",
            Self::Decisions => "Decisions",
            Self::Updates => "Updates",
            Self::TrainingTime => "Training time [s]",
            Self::UpdateRate => "Updates per environment step",
            Self::StepsToThreshold => "Environment steps to threshold",
        }
    }

    /// Returns a description of how it is measured.
    #[must_use]
    pub fn about(self) -> &'static str {
        match self {
            Self::Return => "Mean return of the last evaluation, without exploration noise.",
            Self::Success => "Fraction of the last evaluation's episodes that end in success.",
            Self::ActionChange => {
                "Mean absolute change of the actions between two steps of the last evaluation, \
                 with actions scaled to [-1, 1]. Lower is smoother."
            }
            Self::ActionAcceleration => {
                "Mean absolute second difference of the actions, u(t) - 2 u(t-1) + u(t-2), over \
                 the same episodes as joint jerk, with actions scaled to [-1, 1]. Lower is \
                 smoother."
            }
            Self::JointJerk => {
                "Mean absolute jerk of the joints, computed from their velocities at each step, \
                 over the first evaluation.episodes episodes of the last evaluation. Lower is \
                 smoother. In m/s³ for robots with sliding joints only."
            }
            Self::Sparc => {
                "Spectral arc length of the joints' speed (Balasubramanian et al. 2015), averaged \
                 over the same episodes as joint jerk. Closer to zero is smoother."
            }
            Self::Decisions => {
                "Policy decisions in training, one per segment. An mlp policy decides at every \
                 step."
            }
            Self::Updates => "Updates of the learner in training.",
            Self::TrainingTime => {
                "Wall-clock time of a run. Runs of a sweep share the cores of the machine."
            }
            Self::UpdateRate => "Updates of the learner per environment step.",
            Self::StepsToThreshold => {
                "Environment steps until an evaluation's mean first reaches the threshold. The \
                 resolution is the interval between evaluations."
            }
        }
    }

    /// Returns the number of decimals to show.
    #[must_use]
    pub fn digits(self) -> usize {
        match self {
            Self::Return | Self::Success | Self::Sparc | Self::UpdateRate => 2,
            Self::JointJerk => 1,
            Self::ActionChange => 3,
            Self::ActionAcceleration => 4,
            Self::Decisions | Self::Updates | Self::TrainingTime | Self::StepsToThreshold => 0,
        }
    }

    /// Returns the paper's table for the measure, if it has one.
    #[must_use]
    pub fn in_paper(self) -> Option<PaperTable> {
        match self {
            Self::Return => Some(PaperTable::Return),
            Self::Success => Some(PaperTable::Success),
            _ => None,
        }
    }

    /// Returns true if a higher value is better.
    #[must_use]
    pub fn higher_is_better(self) -> bool {
        matches!(self, Self::Return | Self::Success | Self::Sparc)
    }

    /// Returns true if it is measured by a rollout after training.
    #[must_use]
    pub fn is_of_motion(self) -> bool {
        matches!(self, Self::ActionAcceleration | Self::JointJerk | Self::Sparc)
    }

    /// Returns the group of the measure.
    #[must_use]
    pub fn kind(self) -> MeasureKind {
        match self {
            Self::Return | Self::Success | Self::StepsToThreshold => MeasureKind::Result,
            Self::ActionChange | Self::ActionAcceleration | Self::JointJerk | Self::Sparc => {
                MeasureKind::Smoothness
            }
            Self::Decisions | Self::Updates | Self::TrainingTime | Self::UpdateRate => {
                MeasureKind::Cost
            }
        }
    }

    /// Returns the value of a run; `None` if it is not known yet.
    #[must_use]
    pub fn of(self, run: &Run) -> Option<f64> {
        if self == Self::StepsToThreshold {
            return steps_to_threshold(run);
        }
        let last = run.last()?;
        match self {
            Self::Return => Some(last.return_mean),
            Self::Success => last.success_rate,
            Self::ActionChange => Some(last.smoothness),
            Self::ActionAcceleration => run.motion.as_ref()?.action_acceleration,
            Self::JointJerk => run.motion.as_ref()?.joint_jerk,
            Self::Sparc => run.motion.as_ref()?.sparc,
            Self::Decisions => Some(last.segments as f64),
            Self::Updates => Some(last.updates as f64),
            Self::TrainingTime => Some(last.wall_s),
            Self::UpdateRate => Some(last.updates as f64 / last.env_steps.max(1) as f64),
            Self::StepsToThreshold => None,
        }
    }

    /// Returns the value of one evaluation; `None` for measures of whole runs.
    #[must_use]
    pub fn of_row(self, row: &EvaluationRow) -> Option<f64> {
        match self {
            Self::Return => Some(row.return_mean),
            Self::Success => row.success_rate,
            _ => None,
        }
    }
}

fn steps_to_threshold(run: &Run) -> Option<f64> {
    let threshold = threshold(&run.task)?;
    let reached = |row: &&EvaluationRow| {
        threshold.measure.of_row(row).is_some_and(|value| value >= threshold.value)
    };
    match run.rows.iter().find(reached) {
        Some(row) => Some(row.env_steps as f64),
        // An unfinished run may still reach it.
        None => run.ended.then_some(f64::INFINITY),
    }
}
