//! The whole program with real processes, as a user runs it.
//!
//! All these tests are one executable, because linking is slow and they run in parallel.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod bench;
#[cfg(feature = "hosts")]
mod bridge;
mod browser;
mod chaos;
mod completions;
mod dashboard;
mod dashboard_page;
mod deaths;
mod delivery;
mod demos;
mod determinism;
mod documents;
mod endings;
mod env_kwargs;
mod environments;
mod execution;
mod export;
mod fairness;
mod faults;
#[cfg(feature = "hosts")]
mod hosts;
mod http;
mod hub;
mod interrupts;
mod isolation;
mod joining;
mod learning;
mod leftovers;
mod machine;
mod motion;
mod play;
mod python_front;
mod randomise;
mod record;
mod refusals;
mod report;
mod results;
mod robot;
mod search;
mod shared_directory;
mod start_stop;
mod sweep;
mod trust;
mod variants;
mod zoo;

/// Settings of a cheap run: small networks, few updates, and frequent output of every kind.
const SMALL: [&str; 9] = [
    "policy.hidden=[32,32]",
    "algorithm.critic_hidden=[32,32]",
    "algorithm.batch_size=32",
    "exploration.warm_up_steps=500",
    "pacing.updates_per_segment=0.5",
    "evaluation.episodes=4",
    "evaluation.interval_steps=1000",
    "checkpoint.interval_steps=1000",
    "metrics.interval_steps=500",
];

/// Longer than any test, for runs that end otherwise.
const ENDLESS: &str = "1000000000";

/// Returns the command line of a cheap `train`; `more` comes last and overrides.
fn train<'a>(task: &'a str, run: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = vec!["train", task, "--run-dir", run];
    SMALL.iter().for_each(|setting| arguments.extend(["--set", setting]));
    arguments.extend(more);
    arguments
}
