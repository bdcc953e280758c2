//! Steps E environments of one task with one Python call per segment.

use std::sync::Arc;

use dmprl_shared::config::TaskConfig;
use dmprl_shared::spec::EnvSpec;
use pyo3::{prelude::*, types::PyTuple};
use tracing::info;

use super::{Interpreter, PythonError, buffer::SharedBuffer};
use crate::watchdog::{CallKind, CallState};

/// The environment reported that the last executed step was not a success.
pub const SUCCESS_NO: u8 = 0;
/// The environment reported that the last executed step was a success.
pub const SUCCESS_YES: u8 = 1;
/// The environment does not report success.
pub const SUCCESS_NOT_REPORTED: u8 = 2;

/// E environments (`SegmentEnv` of `envs_py`) with K steps per segment.
///
/// Slices are in C order; the doc comment of each method has the shape. They contain the results of
/// the last call and are valid until the next call, which the borrow checker enforces. After an
/// error the state of the environments is undefined: reset all of them or end the process.
pub struct PythonEnvironments {
    pub(super) spec: EnvSpec,
    /// Why the environments have no goal rule.
    pub(super) missing_rule: Option<String>,
    segment_steps: usize,
    reset: Call,
    step_segment: Call,
    pub(super) env: Py<PyAny>,
    calls: Arc<CallState>,
    mask: SharedBuffer<u8>,
    seeds: SharedBuffer<u64>,
    actions: SharedBuffer<f64>,
    observations: SharedBuffer<f64>,
    rewards: SharedBuffer<f64>,
    terminated: SharedBuffer<u8>,
    truncated: SharedBuffer<u8>,
    success: SharedBuffer<u8>,
    steps: SharedBuffer<i32>,
    failed: SharedBuffer<u8>,
    next_observations: SharedBuffer<f64>,
}

/// A bound method and its arguments. They are created once, because only the contents of the arrays
/// change.
pub(super) struct Call {
    method: Py<PyAny>,
    arguments: Py<PyTuple>,
}

impl Call {
    pub(super) fn new(
        env: &Bound<'_, PyAny>,
        buffers: &Bound<'_, PyAny>,
        method: &str,
        arguments: &[&str],
    ) -> PyResult<Self> {
        let mut values: Vec<_> =
            arguments.iter().map(|name| buffers.getattr(*name)).collect::<PyResult<_>>()?;
        values.push(buffers.clone());
        Ok(Self {
            method: env.getattr(method)?.unbind(),
            arguments: PyTuple::new(env.py(), values)?.unbind(),
        })
    }

    pub(super) fn run(&self) -> Result<(), PythonError> {
        Python::attach(|py| {
            let result = self.method.bind(py).call1(self.arguments.bind(py));
            result.map(drop).map_err(|error| PythonError::exception(py, &error))
        })
    }
}

impl PythonEnvironments {
    /// Creates environments of a task, with its arguments and wrappers. They must be reset before
    /// the first step.
    ///
    /// # Errors
    /// `Exception` with Gymnasium's message for an unknown id or an unsupported space, and with the
    /// environment's own for a wrong argument; `Spec` for unusable bounds, `Interface` or `Length`
    /// if the installed package does not fit.
    pub fn start(
        _interpreter: &Interpreter,
        task: &TaskConfig,
        env_count: usize,
        segment_steps: usize,
    ) -> Result<Self, PythonError> {
        Self::start_with(env_count, segment_steps, |py| {
            let module = py.import("dmprl.segment_env")?;
            let options = read_options(py, task)?;
            module.getattr("make")?.call1((&task.id, env_count, segment_steps, options))
        })
    }

    /// Creates buffers for the `SegmentEnv` that `make` returns, and connects to both.
    pub(super) fn start_with(
        env_count: usize,
        segment_steps: usize,
        make: impl for<'py> FnOnce(Python<'py>) -> PyResult<Bound<'py, PyAny>>,
    ) -> Result<Self, PythonError> {
        Python::attach(|py| {
            let exception = |error: PyErr| PythonError::exception(py, &error);
            let env = make(py).map_err(exception)?;
            let spec = env.call_method0("spec").and_then(|s| read_spec(&s)).map_err(exception)?;
            spec.check()?;
            let (observation_len, action_len) = (spec.observation_len, spec.action_len);
            let buffers = py
                .import("dmprl.segment_env")
                .and_then(|module| module.getattr("SegmentBuffers"))
                .and_then(|new| new.call1((env_count, segment_steps, observation_len, action_len)))
                .map_err(exception)?;
            Self::connect(&env, &buffers, env_count, segment_steps, spec)
        })
    }

    fn connect(
        env: &Bound<'_, PyAny>,
        buffers: &Bound<'_, PyAny>,
        e: usize,
        k: usize,
        spec: EnvSpec,
    ) -> Result<Self, PythonError> {
        let (o, a, id) = (spec.observation_len, spec.action_len, spec.id.as_str());
        let call = |method, arguments: &[&str]| {
            Call::new(env, buffers, method, arguments)
                .map_err(|error| PythonError::exception(env.py(), &error))
        };
        Ok(Self {
            reset: call("reset", &["mask", "seeds"])?,
            step_segment: call("step_segment", &["actions"])?,
            env: env.clone().unbind(),
            calls: Arc::default(),
            mask: SharedBuffer::new(buffers, "mask", e, id)?,
            seeds: SharedBuffer::new(buffers, "seeds", e, id)?,
            actions: SharedBuffer::new(buffers, "actions", e * k * a, id)?,
            observations: SharedBuffer::new(buffers, "observations", e * (k + 1) * o, id)?,
            rewards: SharedBuffer::new(buffers, "rewards", e * k, id)?,
            terminated: SharedBuffer::new(buffers, "terminated", e, id)?,
            truncated: SharedBuffer::new(buffers, "truncated", e, id)?,
            success: SharedBuffer::new(buffers, "success", e, id)?,
            steps: SharedBuffer::new(buffers, "steps", e, id)?,
            failed: SharedBuffer::new(buffers, "failed", e, id)?,
            next_observations: SharedBuffer::new(buffers, "next_observations", e * o, id)?,
            segment_steps: k,
            missing_rule: None,
            spec,
        })
    }

    /// Returns sizes, bounds and timing of an environment.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// Starts a new episode, with seed `seeds[e]`, in every environment with `mask[e]`, and updates
    /// its row of [`Self::next_observations`].
    ///
    /// # Errors
    /// `Length` if an argument does not have E entries; `Exception` if an environment raises.
    pub fn reset(&mut self, mask: &[bool], seeds: &[u64]) -> Result<(), PythonError> {
        self.check_len("mask", mask.len(), self.mask.get().len())?;
        self.check_len("seeds", seeds.len(), self.mask.get().len())?;
        for (to, &from) in self.mask.get_mut().iter_mut().zip(mask) {
            *to = u8::from(from);
        }
        self.seeds.get_mut().copy_from_slice(seeds);
        let _call = self.calls.enter(CallKind::Reset);
        self.reset.run()
    }

    /// Runs `actions` (E, K, A), in environment units. An environment stops at the end of its
    /// episode and starts the next one before this returns (see [`Self::next_observations`]).
    /// [`Self::failed`] marks environments that failed and were recreated.
    ///
    /// # Errors
    /// `Length`; `ActionNotFinite`; `Exception`, with environment and step, if an environment could
    /// not be recreated after a failure.
    pub fn step_segment(&mut self, actions: &[f64]) -> Result<(), PythonError> {
        self.check_len("actions", actions.len(), self.actions.get().len())?;
        if let Some(index) = actions.iter().position(|action| !action.is_finite()) {
            let step_index = index / self.spec.action_len;
            return Err(PythonError::ActionNotFinite {
                task_id: self.spec.id.clone(),
                env_index: step_index / self.segment_steps,
                step: step_index % self.segment_steps,
                value: actions[index],
            });
        }
        self.actions.get_mut().copy_from_slice(actions);
        let call = self.calls.enter(CallKind::StepSegment);
        self.step_segment.run()?;
        drop(call);
        let steps_max = self.segment_steps;
        for (&steps, &failed) in self.steps.get().iter().zip(self.failed.get()) {
            // A user's `SegmentEnv` may be incorrect, and `steps` is used as an index.
            if failed != 0
                || usize::try_from(steps).is_ok_and(|steps| (1..=steps_max).contains(&steps))
            {
                continue;
            }
            return Err(PythonError::Interface {
                task_id: self.spec.id.clone(),
                name: "steps",
                reason: format!("{steps} steps of a segment, expected 1 to {steps_max}"),
            });
        }
        Ok(())
    }

    /// Returns the state of the current call, for [`crate::watchdog`].
    pub fn calls(&self) -> &Arc<CallState> {
        &self.calls
    }

    /// Returns descriptions of the failures since the last call, with environment, step and cause.
    ///
    /// # Errors
    /// `Exception` if a user's `SegmentEnv` raises.
    pub fn take_failures(&mut self) -> Result<Vec<String>, PythonError> {
        Python::attach(|py| {
            let list = self.env.bind(py).call_method0("take_failures");
            let descriptions = list.and_then(|list| list.extract());
            descriptions.map_err(|error| PythonError::exception(py, &error))
        })
    }

    /// Observations, (E, K+1, O). Row k is before step k, and row `steps` after the last executed
    /// step.
    pub fn observations(&self) -> &[f64] {
        self.observations.get()
    }

    /// Rewards, (E, K); zero from `steps` on.
    pub fn rewards(&self) -> &[f64] {
        self.rewards.get()
    }

    /// 1 where the task's own rule ended the episode, (E,).
    pub fn terminated(&self) -> &[u8] {
        self.terminated.get()
    }

    /// 1 where a time limit ended the episode, (E,).
    pub fn truncated(&self) -> &[u8] {
        self.truncated.get()
    }

    /// [`SUCCESS_NO`], [`SUCCESS_YES`] or [`SUCCESS_NOT_REPORTED`] at the last executed step, (E,).
    pub fn success(&self) -> &[u8] {
        self.success.get()
    }

    /// 1 where the environment failed in the last segment and was recreated, (E,). Its other rows
    /// are invalid, and its next observation starts an episode.
    pub fn failed(&self) -> &[u8] {
        self.failed.get()
    }

    /// Number of executed steps, 1 to K, (E,).
    pub fn steps(&self) -> &[i32] {
        self.steps.get()
    }

    /// Observations for the next actions, (E, O). After the end of an episode, this is the first
    /// observation of the next one.
    pub fn next_observations(&self) -> &[f64] {
        self.next_observations.get()
    }

    fn check_len(
        &self,
        name: &'static str,
        got: usize,
        expected: usize,
    ) -> Result<(), PythonError> {
        if got == expected {
            return Ok(());
        }
        Err(PythonError::Length { task_id: self.spec.id.clone(), name, expected, got })
    }
}

impl Drop for PythonEnvironments {
    /// Closes the environments. Those with processes of their own end them.
    fn drop(&mut self) {
        Python::attach(|py| {
            if let Err(error) = self.env.bind(py).call_method0("close") {
                let error = PythonError::exception(py, &error);
                info!("{}: cannot be closed: {error}", self.spec.id);
            }
        });
    }
}

/// Converts the task's arguments and wrappers to an `EnvOptions` of the package `dmprl`.
pub(super) fn read_options<'py>(py: Python<'py>, task: &TaskConfig) -> PyResult<Bound<'py, PyAny>> {
    let class = py.import("dmprl.env_options")?.getattr("EnvOptions")?;
    class.call_method1("parse", (task.options_toml(),))
}

fn read_spec(dict: &Bound<'_, PyAny>) -> PyResult<EnvSpec> {
    let names = dict.call_method1("get", ("observation_names",))?;
    Ok(EnvSpec {
        id: dict.get_item("id")?.extract()?,
        observation_len: dict.get_item("observation_len")?.extract()?,
        action_len: dict.get_item("action_len")?.extract()?,
        action_low: dict.get_item("action_low")?.extract()?,
        action_high: dict.get_item("action_high")?.extract()?,
        control_dt_s: dict.get_item("control_dt_s")?.extract()?,
        episode_steps: dict.get_item("episode_steps")?.extract()?,
        observation_names: if names.is_none() { Vec::new() } else { names.extract()? },
        goal_rule: None,
    })
}
