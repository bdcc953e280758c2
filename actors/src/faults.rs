//! Stage 3 of 8: finds, describes and counts environments that failed in the last call. Called by
//! the rollout and the evaluator.
//!
//! A failed environment loses only its own segment. The Python side recreates it and reports it
//! ([`PythonEnvironments::failed`]). If a `SegmentEnv` returns numbers that are not finite, this
//! module detects it, and the caller resets the environment.

use dmprl_shared::spec::EnvSpec;

use crate::python_env::{PythonEnvironments, PythonError};

/// Maximum length of a description. An exception may contain a whole model file.
const DESCRIPTION_CHARS_MAX: usize = 500;
/// Number of fault-free segments after which earlier failures no longer count, as after a completed
/// episode. An environment without a time limit may never complete an episode.
const FAULT_FREE_SEGMENTS: u32 = 1_000;

/// The failures of a set of environments.
#[derive(Debug)]
pub struct Faults {
    /// Environments that failed in the last call, (E,).
    failed: Vec<bool>,
    /// Failed environments that cannot continue without a reset, (E,).
    needs_reset: Vec<bool>,
    /// Failures that still count, (E,), and their limit.
    records: Vec<FailureRecord>,
    failures_max: u32,
    /// Newest failure of each environment, (E,); empty before the first.
    causes: Vec<String>,
    total: u64,
    unreported: Vec<String>,
}

/// Failures of one environment that still count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct FailureRecord {
    /// Failures since the last completed episode, or since [`FAULT_FREE_SEGMENTS`].
    failures: u32,
    /// Fault-free segments since the first of these failures.
    fault_free_segments: u32,
}

impl FailureRecord {
    fn failed(&mut self) {
        if self.failures == 0 {
            self.fault_free_segments = 0;
        }
        self.failures = self.failures.saturating_add(1);
    }

    fn ran_without_fault(&mut self) {
        self.fault_free_segments += 1;
        if self.fault_free_segments >= FAULT_FREE_SEGMENTS {
            *self = Self::default();
        }
    }
}

/// An environment that has failed too often.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FailureBudgetExceeded {
    /// Index of the environment.
    pub env_index: usize,
    /// Failures that still count.
    pub count: u32,
    /// The last failure.
    pub cause: String,
}

impl Faults {
    /// Creates the records of `envs` environments. The budget of an environment is exceeded by more
    /// than `failures_max` failures without a completed episode or a thousand fault-free segments
    /// in between.
    #[must_use]
    pub fn new(envs: usize, failures_max: u32) -> Self {
        Self {
            failed: vec![false; envs],
            needs_reset: vec![false; envs],
            records: vec![FailureRecord::default(); envs],
            failures_max,
            causes: vec![String::new(); envs],
            total: 0,
            unreported: Vec::new(),
        }
    }

    /// Inspects the results of a segment; returns true if any environment failed.
    ///
    /// # Errors
    /// If the Python side cannot describe the failures.
    pub fn inspect_segment(
        &mut self,
        environments: &mut PythonEnvironments,
    ) -> Result<bool, PythonError> {
        let reported = environments.failed().iter().any(|&failed| failed != 0);
        let mut descriptions = if reported { environments.take_failures()? } else { Vec::new() };
        let environments = &*environments;
        let mut any = false;
        for env in 0..self.failed.len() {
            let recreated = environments.failed()[env] != 0;
            let cause = match recreated {
                true => Some(take_description(&mut descriptions, environments.spec(), env)),
                false => segment_fault(environments, env),
            };
            self.failed[env] = cause.is_some();
            // A recreated environment may still start with a number that is not finite in 32 bits.
            let can_continue = recreated && start_fault(environments, env).is_none();
            self.needs_reset[env] = cause.is_some() && !can_continue;
            if let Some(cause) = cause {
                any = true;
                self.note(&cause);
                self.records[env].failed();
                self.causes[env] = plain(&cause);
            } else {
                self.records[env].ran_without_fault();
            }
        }
        descriptions.iter().for_each(|description| self.note(description));
        Ok(any)
    }

    /// Inspects the results of a reset of the environments in `mask`.
    ///
    /// # Errors
    /// `ObservationNotFinite` if an observation is still not finite.
    pub fn inspect_reset(
        &mut self,
        environments: &mut PythonEnvironments,
        mask: &[bool],
    ) -> Result<(), PythonError> {
        environments.take_failures()?.iter().for_each(|description| self.note(description));
        for env in (0..mask.len()).filter(|&env| mask[env]) {
            if let Some((name, value)) = start_fault(environments, env) {
                let task_id = environments.spec().id.clone();
                return Err(PythonError::ObservationNotFinite { task_id, env, name, value });
            }
        }
        Ok(())
    }

    /// Environments that failed in the last call, (E,).
    #[must_use]
    pub fn failed(&self) -> &[bool] {
        &self.failed
    }

    /// Failed environments that must be reset to continue, (E,).
    #[must_use]
    pub fn needs_reset(&self) -> &[bool] {
        &self.needs_reset
    }

    /// Records that environment `env` has completed an episode.
    pub fn completed(&mut self, env: usize) {
        self.records[env] = FailureRecord::default();
    }

    /// Returns the first environment that has failed too often, if any.
    #[must_use]
    pub fn budget_exceeded(&self) -> Option<FailureBudgetExceeded> {
        let too_many = |record: &FailureRecord| record.failures > self.failures_max;
        let env_index = self.records.iter().position(too_many)?;
        let (count, cause) = (self.records[env_index].failures, self.cause(env_index).to_owned());
        Some(FailureBudgetExceeded { env_index, count, cause })
    }

    /// Returns the newest failure of environment `env`.
    #[must_use]
    pub fn cause(&self, env: usize) -> &str {
        &self.causes[env]
    }

    /// Number of failures so far.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Returns one line for each failure since the last call.
    pub fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.unreported)
    }

    fn note(&mut self, cause: &str) {
        self.total += 1;
        self.unreported.push(plain(cause));
    }
}

/// Replaces control characters and limits the length.
fn plain(cause: &str) -> String {
    let plain = cause.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
    plain.take(DESCRIPTION_CHARS_MAX).collect()
}

/// Removes and returns the description of environment `env`'s failure. A user's `SegmentEnv` may
/// not provide one.
fn take_description(descriptions: &mut Vec<String>, spec: &EnvSpec, env: usize) -> String {
    let name = format!("environment {env},");
    match descriptions.iter().position(|description| description.contains(&name)) {
        Some(at) => descriptions.remove(at),
        None => format!("{}, environment {env}: it failed without a description", spec.id),
    }
}

/// Returns the index of the first number that is not finite in 32 bits, the learner's precision.
fn not_finite(row: &[f64]) -> Option<usize> {
    row.iter().position(|value| !(*value as f32).is_finite())
}

/// Describes the first number of environment `env`'s segment that is not finite.
fn segment_fault(environments: &PythonEnvironments, env: usize) -> Option<String> {
    const EXPECTED: &str = "expected a finite 32-bit number";
    let spec = environments.spec();
    let steps = environments.steps()[env] as usize;
    let rewards = environments.rewards();
    let k_max = rewards.len() / environments.steps().len();
    let place = |when: &str| format!("{}, environment {env}, {when}", spec.id);
    let rewards = &rewards[env * k_max..][..steps];
    if let Some(step) = not_finite(rewards) {
        let place = place(&format!("step {step} of the segment"));
        return Some(format!("{place}: reward is {}, {EXPECTED}", rewards[step]));
    }
    let o = spec.observation_len;
    let rows = &environments.observations()[env * (k_max + 1) * o..][..(steps + 1) * o];
    if let Some(at) = not_finite(rows) {
        let place = place(&format!("step {} of the segment", (at / o).saturating_sub(1)));
        let name = spec.observation_name(at % o);
        return Some(format!("{place}: {name} is {}, {EXPECTED}", rows[at]));
    }
    let (name, value) = start_fault(environments, env)?;
    Some(format!("{}: {name} is {value}, {EXPECTED}", place("reset")))
}

/// Returns name and value of the first entry of the next observation that is not finite.
fn start_fault(environments: &PythonEnvironments, env: usize) -> Option<(String, f64)> {
    let spec = environments.spec();
    let row = &environments.next_observations()[env * spec.observation_len..];
    let row = &row[..spec.observation_len];
    not_finite(row).map(|at| (spec.observation_name(at), row[at]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run_without_fault(faults: &mut Faults, segments: u32) {
        (0..segments).for_each(|_| faults.records[0].ran_without_fault());
    }

    #[test]
    fn fault_free_segments_reset_the_budget_of_an_environment_without_episodes() {
        let mut faults = Faults::new(1, 2);
        for _ in 0..10 {
            (0..2).for_each(|_| faults.records[0].failed());
            assert_eq!(faults.budget_exceeded(), None);
            run_without_fault(&mut faults, FAULT_FREE_SEGMENTS);
        }
    }

    #[test]
    fn too_few_fault_free_segments_do_not_reset_the_budget() {
        let mut faults = Faults::new(1, 2);
        // Segments before the first failure do not count.
        run_without_fault(&mut faults, FAULT_FREE_SEGMENTS - 1);
        faults.records[0].failed();
        run_without_fault(&mut faults, 1);
        (0..2).for_each(|_| faults.records[0].failed());
        assert_eq!(faults.budget_exceeded().unwrap().count, 3);
        faults.completed(0);
        assert_eq!(faults.budget_exceeded(), None);
    }
}
