//! Stage 3 of 8: finds, describes and counts environments that failed in the last call. Called by
//! the rollout and the evaluator.
//!
//! A failed environment loses only its own segment. The Python side makes it again and reports it
//! ([`PythonEnvironments::failed`]). If a `SegmentEnv` returns numbers that are not finite, this
//! module detects it, and the caller resets the environment.

use dmprl_shared::spec::EnvSpec;

use crate::python_env::{PythonEnvironments, PythonError};

/// Maximum length of a description. An exception may contain a whole model file.
const SENTENCE_CHARS_MAX: usize = 500;
/// Number of segments without a fault after which the failures no longer count, as after a
/// completed episode. An environment without a time limit may never complete an episode.
const SOUND_SEGMENTS: u32 = 1_000;

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
    /// Failures since the last completed episode, or since [`SOUND_SEGMENTS`] without a fault.
    failures: u32,
    /// Segments without a fault since the first of these failures.
    sound_segments: u32,
}

impl FailureRecord {
    fn failed(&mut self) {
        if self.failures == 0 {
            self.sound_segments = 0;
        }
        self.failures = self.failures.saturating_add(1);
    }

    fn ran_soundly(&mut self) {
        self.sound_segments += 1;
        if self.sound_segments >= SOUND_SEGMENTS {
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
    /// Creates the record for `envs` environments. The budget is exceeded by more than
    /// `failures_max` failures with neither a completed episode nor a thousand sound segments in
    /// between.
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
        let told = environments.failed().iter().any(|&failed| failed != 0);
        let mut sentences = if told { environments.take_failures()? } else { Vec::new() };
        let environments = &*environments;
        let mut any = false;
        for env in 0..self.failed.len() {
            let made = environments.failed()[env] != 0;
            let cause = match made {
                true => Some(taken(&mut sentences, environments.spec(), env)),
                false => segment_fault(environments, env),
            };
            self.failed[env] = cause.is_some();
            // A remade environment may still begin with a number that is not finite in 32 bits.
            let sound = made && start_fault(environments, env).is_none();
            self.needs_reset[env] = cause.is_some() && !sound;
            if let Some(cause) = cause {
                any = true;
                self.note(&cause);
                self.records[env].failed();
                self.causes[env] = plain(&cause);
            } else {
                self.records[env].ran_soundly();
            }
        }
        sentences.iter().for_each(|sentence| self.note(sentence));
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
        environments.take_failures()?.iter().for_each(|sentence| self.note(sentence));
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

    /// The newest failure of environment `env`.
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
    plain.take(SENTENCE_CHARS_MAX).collect()
}

/// Takes the description of environment `env`'s failure. A user's `SegmentEnv` may give none.
fn taken(sentences: &mut Vec<String>, spec: &EnvSpec, env: usize) -> String {
    let name = format!("environment {env},");
    match sentences.iter().position(|sentence| sentence.contains(&name)) {
        Some(at) => sentences.remove(at),
        None => format!("{}, environment {env}: it failed without a description", spec.id),
    }
}

/// Index of the first number that is not finite in 32 bits, which the learner uses.
fn not_finite(row: &[f64]) -> Option<usize> {
    row.iter().position(|value| !(*value as f32).is_finite())
}

fn segment_fault(environments: &PythonEnvironments, env: usize) -> Option<String> {
    const WHAT: &str = "expected a finite 32-bit number";
    let spec = environments.spec();
    let steps = environments.steps()[env] as usize;
    let rewards = environments.rewards();
    let k_max = rewards.len() / environments.steps().len();
    let where_ = |what: &str| format!("{}, environment {env}, {what}", spec.id);
    let rewards = &rewards[env * k_max..][..steps];
    if let Some(step) = not_finite(rewards) {
        let place = where_(&format!("step {step} of the segment"));
        return Some(format!("{place}: reward is {}, {WHAT}", rewards[step]));
    }
    let o = spec.observation_len;
    let rows = &environments.observations()[env * (k_max + 1) * o..][..(steps + 1) * o];
    if let Some(at) = not_finite(rows) {
        let place = where_(&format!("step {} of the segment", (at / o).saturating_sub(1)));
        let name = spec.observation_name(at % o);
        return Some(format!("{place}: {name} is {}, {WHAT}", rows[at]));
    }
    let (name, value) = start_fault(environments, env)?;
    Some(format!("{}: {name} is {value}, {WHAT}", where_("reset")))
}

/// Name and value of the first entry of the next observation that is not finite.
fn start_fault(environments: &PythonEnvironments, env: usize) -> Option<(String, f64)> {
    let spec = environments.spec();
    let row = &environments.next_observations()[env * spec.observation_len..];
    let row = &row[..spec.observation_len];
    not_finite(row).map(|at| (spec.observation_name(at), row[at]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sound(faults: &mut Faults, segments: u32) {
        (0..segments).for_each(|_| faults.records[0].ran_soundly());
    }

    #[test]
    fn sound_segments_reset_the_budget_of_an_environment_without_episodes() {
        let mut faults = Faults::new(1, 2);
        for _ in 0..10 {
            (0..2).for_each(|_| faults.records[0].failed());
            assert_eq!(faults.budget_exceeded(), None);
            sound(&mut faults, SOUND_SEGMENTS);
        }
    }

    #[test]
    fn too_few_sound_segments_do_not_reset_the_budget() {
        let mut faults = Faults::new(1, 2);
        // Sound segments before the first failure do not count.
        sound(&mut faults, SOUND_SEGMENTS - 1);
        faults.records[0].failed();
        sound(&mut faults, 1);
        (0..2).for_each(|_| faults.records[0].failed());
        assert_eq!(faults.budget_exceeded().unwrap().count, 3);
        faults.completed(0);
        assert_eq!(faults.budget_exceeded(), None);
    }
}
