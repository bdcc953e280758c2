//! Simulates whole sessions with the real state machine and simulated children.
//!
//! Children die, hang, ignore commands and answer late; interrupts, suspensions and failed starts
//! occur. Everything is derived from a seed. After each step, `world.rs` checks the invariants:
//!
//! 1. There is never more than one learner, and no process is started twice at a time.
//! 2. Every process that the run needs is running or has a restart due, and a step is due no later
//!    than that restart.
//! 3. Every evaluation request is answered, waits, is in flight, or is given up with a reason.
//! 4. The totals, and the newest ones sent to the learner, equal what children reported.
//! 5. The machine and the world have the same children, apart from exits that have not arrived.
//! 6. Time advances: no deadline remains due after its step.
//! 7. While the run trains, no ready learner, worker, gateway or relay is silent beyond its limit.
//!
//! After a while all faults stop. Then the session must end within a bounded number of steps; after
//! a stop, within its time limits. A failed test prints its seed. To run only this seed, set
//! `DMPRL_SIMULATION_SEED=<seed>`.

pub(crate) mod fakes;
mod scenario;
mod tally;
mod world;

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use dmprl_run::{Manifest, RunDirectory};
use tally::Tally;
use world::World;

const SEEDS: u64 = 10_000;
const ONE_SEED: &str = "DMPRL_SIMULATION_SEED";

/// Runs one session to its end.
fn run(seed: u64, directory: &RunDirectory) -> Tally {
    let ended = catch_unwind(AssertUnwindSafe(|| World::new(seed, directory).run()));
    ended.unwrap_or_else(|panic| {
        eprintln!(
            "seed {seed} fails; reproduce with: {ONE_SEED}={seed} cargo test --release -p \
             dmprl-supervisor --lib simulation -- --nocapture"
        );
        resume_unwind(panic)
    })
}

#[test]
fn every_simulated_session_keeps_its_invariants_and_ends() {
    let folder = tempfile::tempdir().unwrap();
    let (path, manifest) = (folder.path().join("run"), Manifest::new(None).unwrap());
    let directory = RunDirectory::create(&path, &Default::default(), &manifest).unwrap();
    if let Ok(seed) = std::env::var(ONE_SEED) {
        println!("{:#?}", run(seed.parse().unwrap(), &directory));
        return;
    }
    let mut all = Tally::default();
    (0..SEEDS).for_each(|seed| all.add(&run(seed, &directory)));
    println!("{SEEDS} seeds: {all:#?}");
    // Every kind of event must occur in some session.
    assert_eq!(all.missing(), Vec::<&str>::new());
}
