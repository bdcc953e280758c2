//! A run's policy as one file that goes where the robot is.
//!
//! `onnx` writes the whole policy as a graph, for every runtime of that format; `safetensors` is
//! the project's own file (`dmprl_shared::policy_file`), for Rust and for `dmprl.Policy`.

mod graph;
mod onnx;
mod onnx_format;

use anyhow::Context;
use dmprl_shared::policy::Policy;
use dmprl_shared::policy_file::{self, Match, OpenedPolicy, Origin};

pub use onnx::onnx;

use crate::run_directory::{ChosenPolicy, RunDirectory, Session};

/// Reads a run's policy, with where it comes from.
///
/// # Errors
/// The run says nothing of its environment yet, or the file is damaged.
pub fn read_policy(run: &RunDirectory, chosen: &ChosenPolicy) -> anyhow::Result<OpenedPolicy> {
    let (config, manifest) = (run.config()?, run.manifest()?);
    let spec = run.spec()?.with_context(|| {
        format!("run {} has not started an environment yet", run.path().display())
    })?;
    // By the run's configuration: files of older versions do not say what they are.
    let policy = Policy::new(&config, &spec)?;
    let snapshot = policy_file::load(&chosen.path, &policy, Match::Architecture)?;
    let this = Session::now();
    let origin = Origin {
        run_id: manifest.run_id,
        task: config.task.name,
        seed: config.run.seed,
        dmprl_version: this.dmprl_version,
        git_commit: this.git_commit,
        return_mean: chosen.row.as_ref().map(|row| row.return_mean),
        success_rate: chosen.row.as_ref().and_then(|row| row.success_rate),
    };
    Ok(OpenedPolicy { policy, snapshot, origin: Some(origin) })
}

/// The project's own file, as bytes.
///
/// # Errors
/// None is known: the parameters are the policy's.
pub fn safetensors(opened: &OpenedPolicy) -> anyhow::Result<Vec<u8>> {
    Ok(policy_file::encode(&opened.policy, &opened.snapshot, opened.origin.as_ref())?)
}
