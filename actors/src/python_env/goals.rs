//! Finds goals in an observation, and computes rewards of steps for other goals.

use std::sync::Arc;

use dmprl_shared::goal_rule::{GoalReward, GoalRule, Norm};
use pyo3::prelude::*;

use super::{PythonEnvironments, PythonError, buffer::SharedBuffer, environments::Call};
use crate::watchdog::{CallKind, CallState};

/// Positions of the achieved and the desired goal in an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Goals {
    /// First entry of the achieved goal.
    pub achieved: usize,
    /// First entry of the desired goal.
    pub desired: usize,
    /// Number of entries of each goal, G.
    pub len: usize,
    /// True if the reward only depends on whether the goal is reached.
    pub is_sparse: bool,
}

/// Computes the rewards of up to M steps for other goals in one call, in arrays shared with Python.
pub struct Relabelling {
    task_id: String,
    relabel: Call,
    calls: Arc<CallState>,
    goal_len: usize,
    count: SharedBuffer<u64>,
    achieved: SharedBuffer<f64>,
    desired: SharedBuffer<f64>,
    rewards: SharedBuffer<f64>,
    terminated: SharedBuffer<u8>,
}

impl PythonEnvironments {
    /// Returns the positions of the goals in an observation.
    ///
    /// # Errors
    /// `NoGoals` with the reason if the environment has no goals or cannot compute their rewards.
    pub fn goals(&self) -> Result<Goals, PythonError> {
        let goals = Python::attach(|py| {
            let goals = self.env.bind(py).call_method0("goals");
            goals.and_then(|dict| read_goals(&dict)).map_err(|error| {
                match PythonError::exception(py, &error) {
                    PythonError::Exception { kind, message, .. }
                        if kind == "NotGoalConditionedError" =>
                    {
                        PythonError::NoGoals { reason: message }
                    }
                    other => other,
                }
            })
        })?;
        let (spec, Goals { achieved, desired, len, .. }) = (self.spec(), goals);
        let fits =
            |first: usize| first.checked_add(len).is_some_and(|end| end <= spec.observation_len);
        if len > 0 && fits(achieved) && fits(desired) {
            return Ok(goals);
        }
        Err(PythonError::Interface {
            task_id: spec.id.clone(),
            name: "goals",
            reason: format!(
                "{goals:?} do not fit observations of {} entries",
                spec.observation_len
            ),
        })
    }

    /// Looks for the rule by which the environment rewards goals, and adds it to the spec if it is
    /// proven. [`PythonEnvironments::missing_rule`] has the reason if not. Resets an environment,
    /// because rewards may depend on what a reset creates.
    ///
    /// # Errors
    /// `NoGoals` as [`PythonEnvironments::goals`]; `Exception` if the reset fails; `Spec` if the
    /// installed package does not fit.
    pub fn find_goal_rule(&mut self) -> Result<(), PythonError> {
        let envs = self.failed().len();
        let first: Vec<bool> = (0..envs).map(|env| env == 0).collect();
        self.reset(&first, &vec![0; envs])?;
        let goals = self.goals()?;
        let calls = Arc::clone(self.calls());
        let call = calls.enter(CallKind::Relabel);
        let found = Python::attach(|py| {
            let module = py.import("dmprl.goal_rule")?;
            let proven = module.getattr("proven")?.call1((self.env.bind(py),))?;
            read_rule(&proven, goals)
        });
        drop(call);
        match found {
            Ok(rule) => self.spec.goal_rule = Some(Box::new(rule)),
            Err(error) => {
                let error = Python::attach(|py| PythonError::exception(py, &error));
                match error {
                    PythonError::Exception { kind, message, .. } if kind == "NoGoalRuleError" => {
                        self.missing_rule = Some(message);
                    }
                    other => return Err(other),
                }
            }
        }
        Ok(self.spec.check()?)
    }

    /// Returns why [`PythonEnvironments::find_goal_rule`] found no rule.
    #[must_use]
    pub fn missing_rule(&self) -> Option<&str> {
        self.missing_rule.as_deref()
    }

    /// Creates the buffers for up to `rows_max` steps with goals of `goal_len` entries.
    ///
    /// # Errors
    /// `Interface` or `Length` if the installed package does not fit.
    pub fn relabelling(
        &self,
        rows_max: usize,
        goal_len: usize,
    ) -> Result<Relabelling, PythonError> {
        let id = self.spec().id.as_str();
        Python::attach(|py| {
            let exception = |error: PyErr| PythonError::exception(py, &error);
            let rows = py
                .import("dmprl.segment_env")
                .and_then(|module| module.getattr("GoalRows")?.call1((rows_max, goal_len)))
                .map_err(exception)?;
            let relabel = Call::new(self.env.bind(py), &rows, "relabel", &[]).map_err(exception)?;
            Ok(Relabelling {
                relabel,
                calls: Arc::clone(self.calls()),
                goal_len,
                count: SharedBuffer::new(&rows, "count", 1, id)?,
                achieved: SharedBuffer::new(&rows, "achieved", rows_max * goal_len, id)?,
                desired: SharedBuffer::new(&rows, "desired", rows_max * goal_len, id)?,
                rewards: SharedBuffer::new(&rows, "rewards", rows_max, id)?,
                terminated: SharedBuffer::new(&rows, "terminated", rows_max, id)?,
                task_id: id.to_owned(),
            })
        })
    }
}

impl Relabelling {
    /// Sets row `row`: the achieved goal of the step, (G,), and the desired goal, (G,).
    ///
    /// # Panics
    /// If `row` is not below M.
    pub fn set(&mut self, row: usize, achieved: &[f64], desired: &[f64]) {
        let entries = row * self.goal_len..(row + 1) * self.goal_len;
        self.achieved.get_mut()[entries.clone()].copy_from_slice(achieved);
        self.desired.get_mut()[entries].copy_from_slice(desired);
    }

    /// Computes the rewards of the first `rows` rows.
    ///
    /// # Errors
    /// `Exception` if the environment raises; `GoalRewardNotFinite`.
    pub fn run(&mut self, rows: usize) -> Result<(), PythonError> {
        self.count.get_mut()[0] = rows as u64;
        let call = self.calls.enter(CallKind::Relabel);
        self.relabel.run()?;
        drop(call);
        let rewards = &self.rewards.get()[..rows];
        match rewards.iter().find(|reward| !(**reward as f32).is_finite()) {
            Some(&value) => {
                Err(PythonError::GoalRewardNotFinite { task_id: self.task_id.clone(), value })
            }
            None => Ok(()),
        }
    }

    /// Rewards, (M,).
    pub fn rewards(&self) -> &[f64] {
        self.rewards.get()
    }

    /// Non-zero where the step would have ended its episode, (M,).
    pub fn terminated(&self) -> &[u8] {
        self.terminated.get()
    }
}

fn read_goals(dict: &Bound<'_, PyAny>) -> PyResult<Goals> {
    Ok(Goals {
        achieved: dict.get_item("achieved")?.extract()?,
        desired: dict.get_item("desired")?.extract()?,
        len: dict.get_item("length")?.extract()?,
        is_sparse: dict.get_item("sparse")?.extract()?,
    })
}

fn read_rule(dict: &Bound<'_, PyAny>, goals: Goals) -> PyResult<GoalRule> {
    let number = |name: &str| dict.get_item(name)?.extract::<f64>();
    let is_sparse = dict.contains("threshold")?;
    Ok(GoalRule {
        achieved: goals.achieved,
        desired: goals.desired,
        goal_len: goals.len,
        components: dict.get_item("components")?.extract()?,
        norm: match dict.get_item("norm")?.extract::<String>()?.as_str() {
            "max" => Norm::Max,
            _ => Norm::Euclidean,
        },
        reward: if is_sparse {
            GoalReward::Sparse {
                threshold: number("threshold")?,
                reached: number("reached")?,
                missed: number("missed")?,
            }
        } else {
            GoalReward::Dense { factor: number("factor")? }
        },
        ends_within: dict.get_item("ends_within")?.extract()?,
    })
}
