//! Environments that failed in the last call: found, described, counted.
//!
//! A failed environment costs its own segment and nothing else. The Python side makes it again and
//! says so ([`PythonEnvironments::failed`]); a `SegmentEnv` that hands out numbers that are not
//! finite without noticing is found here, and reset by the caller.

use dmprl_shared::spec::EnvSpec;

use crate::python_env::{PythonEnvironments, PythonError};

/// Longer descriptions are cut: an exception may carry a whole model file.
const SENTENCE_CHARS_MAX: usize = 500;
/// Segments without a fault that make up for failures as a completed episode does: an environment
/// without a time limit may never complete one, and failures far apart are no reason to give up.
const SOUND_SEGMENTS: u32 = 1_000;

/// The failures of a set of environments.
#[derive(Debug)]
pub struct Faults {
    /// (E,): whose last call cannot be used.
    failed: Vec<bool>,
    /// (E,): those of them that cannot go on as they are.
    needs_reset: Vec<bool>,
    /// (E,): failures that nothing has made up for, and how many are too many.
    records: Vec<FailureRecord>,
    failures_max: u32,
    /// (E,): the newest failure of each; empty before the first.
    causes: Vec<String>,
    total: u64,
    unreported: Vec<String>,
}

/// What counts against one environment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct FailureRecord {
    /// Since it last completed an episode or ran [`SOUND_SEGMENTS`].
    failures: u32,
    /// Since the first of them.
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

/// An environment that fails whatever is done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FailureBudgetExceeded {
    /// Which.
    pub env_index: usize,
    /// Failures since it last completed an episode, or a thousand segments.
    pub count: u32,
    /// The last one.
    pub cause: String,
}

impl Faults {
    /// For `envs` environments; more than `failures_max` failures without a completed episode, or
    /// a thousand sound segments, in between are hopeless.
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

    /// Looks at what a segment left; true if any environment failed.
    ///
    /// # Errors
    /// If the Python side cannot say what happened.
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
            // One that was made again may still begin with what is no finite 32-bit number.
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

    /// Looks at what a reset of the environments in `mask` left.
    ///
    /// # Errors
    /// `ObservationNotFinite`: a reset is all that could have helped.
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

    /// (E,): whose last call cannot be used.
    #[must_use]
    pub fn failed(&self) -> &[bool] {
        &self.failed
    }

    /// (E,): those of them that cannot go on as they are: they must be reset.
    #[must_use]
    pub fn needs_reset(&self) -> &[bool] {
        &self.needs_reset
    }

    /// Environment `env` has completed an episode.
    pub fn completed(&mut self, env: usize) {
        self.records[env] = FailureRecord::default();
    }

    /// The environment that has failed too often, if there is one.
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

    /// All failures so far.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.total
    }

    /// One line about each failure since the last call.
    pub fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.unreported)
    }

    fn note(&mut self, cause: &str) {
        self.total += 1;
        self.unreported.push(plain(cause));
    }
}

/// One line that steers no terminal.
fn plain(cause: &str) -> String {
    let plain = cause.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
    plain.take(SENTENCE_CHARS_MAX).collect()
}

/// The sentence about environment `env`; a `SegmentEnv` of somebody's own may have none.
fn taken(sentences: &mut Vec<String>, spec: &EnvSpec, env: usize) -> String {
    let name = format!("environment {env},");
    match sentences.iter().position(|sentence| sentence.contains(&name)) {
        Some(at) => sentences.remove(at),
        None => format!("{}, environment {env}: it failed and does not say how", spec.id),
    }
}

/// The first number of a row that is not finite in 32 bits, in which the learner gets it.
fn not_finite(row: &[f64]) -> Option<usize> {
    row.iter().position(|value| !(*value as f32).is_finite())
}

fn segment_fault(environments: &PythonEnvironments, env: usize) -> Option<String> {
    const WHAT: &str = "which is no finite 32-bit number";
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

/// Name and value of what is not finite in the observation to act on next.
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
    fn an_environment_that_never_completes_an_episode_makes_up_with_sound_segments() {
        let mut faults = Faults::new(1, 2);
        for _ in 0..10 {
            (0..2).for_each(|_| faults.records[0].failed());
            assert_eq!(faults.budget_exceeded(), None);
            sound(&mut faults, SOUND_SEGMENTS);
        }
    }

    #[test]
    fn fewer_sound_segments_between_too_many_failures_make_up_for_nothing() {
        let mut faults = Faults::new(1, 2);
        // Sound segments before a failure are none of its reasons.
        sound(&mut faults, SOUND_SEGMENTS - 1);
        faults.records[0].failed();
        sound(&mut faults, 1);
        (0..2).for_each(|_| faults.records[0].failed());
        assert_eq!(faults.budget_exceeded().unwrap().count, 3);
        faults.completed(0);
        assert_eq!(faults.budget_exceeded(), None);
    }
}
