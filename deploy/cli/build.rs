//! Records the commit that the program is built from, and links libpython of the chosen interpreter
//! with a run path.
//!
//! `actors/build.rs` finds libpython. Cargo passes its result in an environment variable, because
//! `dmprl-actors` has a `links` key.

use std::path::Path;
use std::process::{Command, Stdio};

/// The project's root, relative to this crate.
const ROOT: &str = "../..";

/// Sources of the program, relative to the project's root, without documentation and tests. The
/// Python package is not compiled in; a run's manifest has its hash.
const SOURCES: [&str; 23] = [
    "Cargo.toml",
    "Cargo.lock",
    "shared/Cargo.toml",
    "shared/src",
    "shared/runtime/Cargo.toml",
    "shared/runtime/src",
    "actors/Cargo.toml",
    "actors/build.rs",
    "actors/src",
    "learner/Cargo.toml",
    "learner/src",
    "deploy/analysis",
    "deploy/bench",
    "deploy/bridge",
    "deploy/chaos",
    "deploy/cli",
    "deploy/control",
    "deploy/dashboard",
    "deploy/extension",
    "deploy/run",
    "deploy/supervisor",
    "deploy/sweep",
    "deploy/experiments/paper-statements.toml",
];

fn main() {
    // Absent without the feature `python`.
    if let Ok(link_arg) = std::env::var("DEP_DMPRL_PYTHON_LINK_ARG") {
        println!("cargo::rustc-link-arg={link_arg}");
    }
    let root = Path::new(ROOT);
    for source in SOURCES.iter().filter(|source| root.join(source).exists()) {
        println!("cargo::rerun-if-changed={ROOT}/{source}");
    }
    let commit = commit();
    // Without our prefix `DMPRL_`: Cargo also sets the variable for programs that it runs, and they
    // would take it for a configuration key.
    println!("cargo::rustc-env=GIT_COMMIT_OF_BUILD={}", commit.unwrap_or_default());
}

/// Returns the checked-out commit, with the suffix `-dirty` if the sources differ from it; `None`
/// outside a git repository. Cargo runs this again after a new commit.
fn commit() -> Option<String> {
    // Ignore the repository of another project that contains this directory.
    if !git(&["rev-parse", "--show-prefix"])?.is_empty() {
        return None;
    }
    // `logs/HEAD` changes with every commit and checkout, even if refs are packed.
    let mut heads = ["HEAD", "logs/HEAD", "packed-refs"].map(str::to_owned).to_vec();
    heads.extend(git(&["symbolic-ref", "--quiet", "HEAD"]));
    for head in heads {
        // Cargo counts a missing path as changed in every build.
        if let Some(path) = git(&["rev-parse", "--git-path", &head])
            && Path::new(ROOT).join(&path).exists()
        {
            let path = Path::new(ROOT).join(path);
            println!("cargo::rerun-if-changed={}", path.display());
        }
    }
    let hash = git(&["rev-parse", "--verify", "HEAD"])?;
    let status = ["status", "--porcelain", "--untracked-files=normal", "--"];
    let changes = git(&[&status[..], &SOURCES[..]].concat())?;
    Some(if changes.is_empty() { hash } else { format!("{hash}-dirty") })
}

/// Returns the standard output of a git command in the project's root; `None` if it fails.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git")
        .args(arguments)
        .current_dir(ROOT)
        // Takes no lock that would block a concurrent commit.
        .env("GIT_OPTIONAL_LOCKS", "0")
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .output()
        .ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
