//! Manifests against the types that Kubernetes and JobSet publish, and the Compose file.
//!
//! A package of its own: these types take half a minute to compile, and sharing features with them
//! would compile the program a second time for its tests.
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod compose;
mod kubernetes;
mod schema;

use std::fs;
use std::path::Path;

fn read(path: &str) -> String {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path);
    fs::read_to_string(file).unwrap_or_else(|error| panic!("{path}: {error}"))
}
