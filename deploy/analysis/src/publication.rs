//! A policy as the files of a repository on a model hub, and as a run directory again.
//!
//! `dmprl push` uploads the files that [`fn@write`] writes. `dmprl pull` downloads them, and
//! [`as_run`] turns their folder into a run directory with one policy.

use std::fs;
use std::path::Path;

use anyhow::{Context, bail};
use dmprl_run::{ChosenPolicy, Manifest, PolicyChoice, RunDirectory, replace_file};
use dmprl_shared::config::{BridgeConfig, ExperimentConfig};
use dmprl_shared::policy_file::{self, OpenedPolicy};

use crate::export::{read_policy, safetensors};

/// Name of the policy in a repository, as `dmprl.hub.POLICY` in Python.
pub const POLICY_FILE: &str = "policy.safetensors";
/// Characters that end a path in an argument, as in `--set demonstrations.files=['/a','/b']`.
const AROUND_PATHS: [char; 9] = ['=', ',', '\'', '"', '[', ']', '{', '}', ' '];

/// Writes the policy and the files of its run that a copy needs into `folder`, which is created.
///
/// Absolute paths in command lines are shortened to their last part, and other hosts are removed
/// from them. The configuration names neither, except in arguments of the environment. Evaluations
/// of other policies are written without the returns of their episodes.
///
/// # Errors
/// A file of the run cannot be read, or an I/O error.
pub fn write(
    run: &RunDirectory,
    chosen: &ChosenPolicy,
    opened: &OpenedPolicy,
    folder: &Path,
) -> anyhow::Result<()> {
    let (config, manifest) = (without_folders(run.config()?), without_folders_of(run.manifest()?));
    let written = RunDirectory::create(folder, &config, &manifest)?;
    written.write_spec(&opened.policy.description().spec)?;
    for mut row in run.evaluations()? {
        if row.policy_version != chosen.version {
            row.returns.clear();
        }
        written.append_evaluation(&row)?;
    }
    replace_file(&folder.join(POLICY_FILE), &safetensors(opened)?)
}

/// Turns a folder with downloaded files into a run directory with this one policy, and checks that
/// configuration, environment and policy go with each other.
///
/// # Errors
/// A file is missing, damaged or of another program, or the policy has no evaluation.
pub fn as_run(folder: &Path) -> anyhow::Result<(RunDirectory, ChosenPolicy)> {
    let file = folder.join(POLICY_FILE);
    let version = policy_file::open(&file)?.snapshot.version;
    let run = RunDirectory::open(folder)?;
    // A repository that was not made by `push` may name folders and hosts of this machine.
    run.write_config(&without_folders(run.config()?))?;
    let rows = run.evaluations()?;
    let Some(row) = rows.into_iter().rfind(|row| row.policy_version == version) else {
        bail!("{} has no row of policy {version}", run.evaluations_path().display());
    };
    fs::remove_file(run.evaluations_path()).context("cannot remove the evaluations")?;
    run.append_evaluation(&row)?;
    let policy = run.policy_path(version);
    fs::create_dir_all(folder.join("policies"))
        .and_then(|()| fs::rename(&file, &policy))
        .with_context(|| format!("cannot move {}", file.display()))?;
    let chosen = run.choose_policy(PolicyChoice::Version(version))?;
    read_policy(&run, &chosen)?;
    Ok((run, chosen))
}

/// Removes paths and addresses of this machine and its network from a configuration.
fn without_folders(mut config: ExperimentConfig) -> ExperimentConfig {
    config.task.python_path.clear();
    config.bridge = BridgeConfig::default();
    for file in &mut config.demonstrations.files {
        *file = last_part(file).to_owned();
    }
    config
}

/// Shortens paths in the commands of a manifest to their last part.
fn without_folders_of(mut manifest: Manifest) -> Manifest {
    manifest.init_from = manifest.init_from.map(|path| last_part(&path).to_owned());
    for session in &mut manifest.sessions {
        for (index, word) in session.command.iter_mut().enumerate() {
            if let Some((key, _)) = word.split_once('=')
                && key.starts_with("bridge.")
            {
                *word = format!("{key}=…");
                continue;
            }
            let parts = word.split_inclusive(AROUND_PATHS);
            let is_path = |part: &str| index == 0 || part.starts_with('/');
            *word = parts.map(|part| if is_path(part) { last_part(part) } else { part }).collect();
        }
    }
    manifest
}

fn last_part(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_the_machine_are_not_published() {
        let mut config = ExperimentConfig::default();
        config.task.python_path = vec!["/home/me/tasks".into()];
        config.demonstrations.files = vec!["/home/me/demos.npz".into()];
        config.bridge.listen = vec!["tls/10.0.0.1:7447".into()];
        config.bridge.token_file = "/home/me/token".into();
        let config = without_folders(config);
        assert_eq!(config.task.python_path, Vec::<String>::new());
        assert_eq!(config.demonstrations.files, ["demos.npz"]);
        assert_eq!(config.bridge, BridgeConfig::default());
    }

    #[test]
    fn commands_keep_only_the_last_part_of_a_path() {
        let mut manifest = Manifest::new(Some("/home/me/runs/old/policies/7.safetensors".into()));
        let manifest = manifest.as_mut().unwrap();
        manifest.sessions[0].command = [
            "target/release/dmprl",
            "train",
            "arms/reach:Arm-v0",
            "--run-dir=/home/me/runs/mine",
            "--demos",
            "/home/me/demos.npz",
            "--set",
            "demonstrations.files=['/home/me/a.npz','/home/me/b.npz']",
            "--set",
            "bridge.listen=['tls/10.0.0.1:7447']",
        ]
        .map(str::to_owned)
        .into();
        let manifest = without_folders_of(manifest.clone());
        assert_eq!(manifest.init_from.as_deref(), Some("7.safetensors"));
        let expected = [
            "dmprl",
            "train",
            "arms/reach:Arm-v0",
            "--run-dir=mine",
            "--demos",
            "demos.npz",
            "--set",
            "demonstrations.files=['a.npz','b.npz']",
            "--set",
            "bridge.listen=…",
        ];
        assert_eq!(manifest.sessions[0].command, expected);
    }
}
