//! Files that start dmprl on many machines: the Slurm script against an imitation of Slurm, units
//! and the Compose file against their own programs where these are installed. `tests/manifests`
//! checks the Kubernetes manifests.
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod own_checks;
mod slurm;
mod slurm_array;

use std::fs;

use dmprl_tests::project_root;

fn read(path: &str) -> String {
    fs::read_to_string(project_root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}
