//! What runs dmprl on many machines, held to what it is written for: the manifests to Kubernetes'
//! and JobSet's published types, the Slurm script to a play of Slurm, units and Compose file to
//! their own programs where these are installed.
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod kubernetes;
mod own_checks;
mod slurm;

use std::fs;

use dmprl_tests::project_root;

fn read(path: &str) -> String {
    fs::read_to_string(project_root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}
