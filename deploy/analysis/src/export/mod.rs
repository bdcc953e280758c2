//! Exports a run's policy as a single file, for use on a robot.
//!
//! `onnx` encodes the complete policy as a graph for any ONNX runtime. `safetensors` encodes it in
//! the project's own format (`dmprl_runtime::policy_file`), for Rust and for `dmprl.Policy`.

mod graph;
mod onnx;
mod onnx_format;

use anyhow::Context;
use dmprl_shared::policy::Policy;
use dmprl_shared::policy_file::{self, Match, OpenedPolicy, Origin};

pub use onnx::onnx;

use dmprl_run::{ChosenPolicy, RunDirectory, Session};

/// Reads a run's policy and its origin. A run knows no robot, so the policy has no hold.
///
/// # Errors
/// The run has not started an environment yet, or a file cannot be read.
pub fn read_policy(run: &RunDirectory, chosen: &ChosenPolicy) -> anyhow::Result<OpenedPolicy> {
    let (config, manifest) = (run.config()?, run.manifest()?);
    let spec = run.spec()?.with_context(|| {
        format!("run {} has not started an environment yet", run.path().display())
    })?;
    // Uses the run's configuration, because policy files of older versions have no description.
    let policy = Policy::new(config.policy_description(&spec))?;
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
    // A run knows no robot, but a downloaded policy may.
    let hold = policy_file::open(&chosen.path).ok().and_then(|opened| opened.hold);
    Ok(OpenedPolicy { policy, snapshot, origin: Some(origin), hold })
}

/// Encodes a policy in the project's own format.
///
/// # Errors
/// The parameters do not match the policy, which is not expected.
pub fn safetensors(opened: &OpenedPolicy) -> anyhow::Result<Vec<u8>> {
    let OpenedPolicy { policy, snapshot, origin, hold } = opened;
    Ok(policy_file::encode(policy, snapshot, origin.as_ref(), hold.as_ref())?)
}
