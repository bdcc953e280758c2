//! Everything that is read from outside, fed with what is nearly right: segments in shared memory,
//! the segment log, checkpoints, policies, configurations, lines of the control protocol.
//!
//! Whatever comes, nothing panics, hangs, or asks for more memory than its limit; what is refused
//! changes nothing, and what is accepted is sound. Inputs are made from valid ones by small
//! changes, mostly with their checksums made right again, so that they come past the first door.
//!
//! A failure names its target and seed; `DMPRL_FUZZ_SEED=<seed>` runs that one alone, and
//! `DMPRL_FUZZ_SECONDS=<seconds>` each target for so long instead of its usual number of cases.

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

/// What became of an input.
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

/// A test and how often it tries.
#[derive(Debug, Clone, Copy)]
struct Target {
    /// The test's path, to run it alone.
    name: &'static str,
    /// Cases of a usual run, all targets together a few seconds.
    cases: u64,
    /// Memory that one case may hold at once [bytes].
    bytes_max: usize,
}

impl Target {
    /// Runs the cases; both verdicts must occur, or nothing was tested.
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
