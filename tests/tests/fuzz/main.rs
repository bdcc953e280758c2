//! Fuzzes everything that is read from outside: segments in shared memory, the segment log,
//! checkpoints, policies, configurations, lines of the control protocol.
//!
//! No input may cause a panic, a hang, or more memory than its limit. Rejected input changes
//! nothing, and accepted input is sound. Inputs are valid ones with small changes, most with
//! corrected checksums, so that they pass the first check.
//!
//! A failure prints its target and seed. `DMPRL_FUZZ_SEED=<seed>` runs that case alone, and
//! `DMPRL_FUZZ_SECONDS=<seconds>` runs each target for this time instead of its number of cases.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

mod bounds;
mod checkpoint;
mod configuration;
mod control;
mod fixture;
mod mutate;
mod policy;
mod segment_log;
mod segments;

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::{Duration, Instant};

use dmprl_shared::seeds;
use mutate::Random;

const ONE_SEED: &str = "DMPRL_FUZZ_SEED";
const SECONDS: &str = "DMPRL_FUZZ_SECONDS";

/// Outcome of an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Accepted,
    Refused,
}

impl Verdict {
    fn of<T, E>(result: &Result<T, E>) -> Self {
        if result.is_ok() { Self::Accepted } else { Self::Refused }
    }
}

/// A fuzz target and its number of cases.
#[derive(Debug, Clone, Copy)]
struct Target {
    /// Path of the test, to run it alone.
    name: &'static str,
    /// Number of cases of a usual run; all targets take a few seconds.
    cases: u64,
    /// Memory limit of one case [bytes].
    bytes_max: usize,
}

impl Target {
    /// Runs the cases. Both outcomes must occur; otherwise nothing was tested.
    fn fuzz(self, mut case: impl FnMut(&mut Random) -> Verdict) {
        let mut run = |seed: u64| {
            let stream = seeds::stream(seed, self.name, 0);
            let _watched = bounds::Watched::new(self, seed);
            catch_unwind(AssertUnwindSafe(|| case(&mut Random::new(stream)))).unwrap_or_else(
                |panic| {
                    bounds::tell(self.name, seed, "panicked");
                    resume_unwind(panic)
                },
            )
        };
        if let Ok(seed) = std::env::var(ONE_SEED) {
            println!("{}: {:?}", self.name, run(seed.parse().unwrap()));
            return;
        }
        let seconds = std::env::var(SECONDS).ok().map(|text| text.parse().unwrap());
        let (started, limit) = (Instant::now(), seconds.map(Duration::from_secs));
        let (mut accepted, mut seed) = (0_u64, 0_u64);
        while limit.map_or(seed < self.cases, |limit| started.elapsed() < limit) {
            accepted += u64::from(run(seed) == Verdict::Accepted);
            seed += 1;
        }
        let took = started.elapsed();
        println!("{}: {seed} cases, {accepted} accepted, {took:.1?}", self.name);
        assert!(accepted > 0 && accepted < seed, "{accepted} of {seed} accepted");
    }
}
