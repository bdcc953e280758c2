//! Records which commit the program is built from, and lets its executables find libpython where
//! the linked interpreter keeps it.
//!
//! `actors/build.rs` asked the interpreter; its answer arrives in the environment because
//! `dmprl-actors` has a `links` key.

use std::path::Path;
use std::process::{Command, Stdio};

/// The project's root, relative to this crate.
const ROOT: &str = "../..";

/// What the program is compiled from, relative to the project's root. Documents and tests are no
/// part of it. The Python package is read when a run starts: a manifest has its hash.
const SOURCES: [&str; 20] = [
    "Cargo.toml",
    "Cargo.lock",
    "shared/Cargo.toml",
    "shared/src",
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
    // Cargo also sets this for programs that it runs. A name with our own prefix would be taken for
    // a configuration key.
    println!("cargo::rustc-env=GIT_COMMIT_OF_BUILD={}", commit.unwrap_or_default());
}

/// The commit that is checked out, with `-dirty` where the sources differ from it; none outside a
/// git repository. A new commit makes Cargo run this again.
fn commit() -> Option<String> {
    // A folder inside another project's repository has that project's commits.
    if !git(&["rev-parse", "--show-prefix"])?.is_empty() {
        return None;
    }
    // `logs/HEAD` grows with every commit and checkout, also where refs are packed.
    let mut heads = ["HEAD", "logs/HEAD", "packed-refs"].map(str::to_owned).to_vec();
    heads.extend(git(&["symbolic-ref", "--quiet", "HEAD"]));
    for head in heads {
        // A path that is not there would count as changed in every build.
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

/// Standard output of a git command in the project's root.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git")
        .args(arguments)
        .current_dir(ROOT)
        // Takes no lock that a commit at the same time would wait for.
        .env("GIT_OPTIONAL_LOCKS", "0")
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .output()
        .ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
