//! `policies/<version>.safetensors`: chooses, lists and prunes saved policies.

use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use dmprl_shared::supervision::EvaluationRow;

use crate::atomic;
use crate::directory::RunDirectory;
use crate::failure::wrong_use;

/// A user's choice of a saved policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PolicyChoice {
    /// The policy with the highest evaluation return.
    Best,
    /// The policy that was evaluated last.
    Latest,
    /// The policy with this version.
    Version(u64),
}

impl FromStr for PolicyChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "best" => Ok(Self::Best),
            "latest" => Ok(Self::Latest),
            number => number
                .parse()
                .map(Self::Version)
                .map_err(|_| "expected best, latest or a version number".into()),
        }
    }
}

impl Display for PolicyChoice {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Best => formatter.write_str("best"),
            Self::Latest => formatter.write_str("latest"),
            Self::Version(version) => write!(formatter, "{version}"),
        }
    }
}

/// A saved policy and its evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct ChosenPolicy {
    /// Version of the policy.
    pub version: u64,
    /// Path of its file, which exists.
    pub path: PathBuf,
    /// Its evaluation, if the run has evaluated it.
    pub row: Option<EvaluationRow>,
}

impl RunDirectory {
    /// Path of a policy's file.
    #[must_use]
    pub fn policy_path(&self, version: u64) -> PathBuf {
        self.path().join("policies").join(format!("{version}.safetensors"))
    }

    /// Finds the policy that the user chose.
    ///
    /// # Errors
    /// Wrong use: the run has no evaluation yet, or no such version; the error lists the saved
    /// versions.
    pub fn choose_policy(&self, choice: PolicyChoice) -> anyhow::Result<ChosenPolicy> {
        let row = match choice {
            PolicyChoice::Best => self.best_row()?,
            PolicyChoice::Latest => self.latest_row()?,
            PolicyChoice::Version(version) => {
                self.evaluations()?.into_iter().rfind(|row| row.policy_version == version)
            }
        };
        let version = match (choice, &row) {
            (PolicyChoice::Version(version), _) => version,
            (_, Some(row)) => row.policy_version,
            (_, None) => {
                return Err(wrong_use(format!(
                    "run {} has no evaluation yet, so no {choice} policy; resume it: dmprl resume \
                     {}",
                    self.path().display(),
                    self.path().display()
                )));
            }
        };
        let path = self.policy_path(version);
        if path.is_file() {
            return Ok(ChosenPolicy { version, path, row });
        }
        let saved: Vec<String> = self.saved_policies()?.iter().map(u64::to_string).collect();
        Err(wrong_use(format!(
            "run {} has no saved policy {version}; saved: {}",
            self.path().display(),
            if saved.is_empty() { "none".into() } else { saved.join(", ") }
        )))
    }

    /// Lists the versions of the saved policies.
    ///
    /// # Errors
    /// An I/O error.
    pub fn saved_policies(&self) -> anyhow::Result<BTreeSet<u64>> {
        let folder = self.path().join("policies");
        let entries =
            folder.read_dir().with_context(|| format!("cannot read {}", folder.display()))?;
        let mut versions = BTreeSet::new();
        for entry in entries {
            let name =
                entry.with_context(|| format!("cannot read {}", folder.display()))?.file_name();
            let version = name.to_str().and_then(|name| name.strip_suffix(".safetensors"));
            versions.extend(version.and_then(|version| version.parse::<u64>().ok()));
        }
        Ok(versions)
    }

    /// Points the link `checkpoints/best` at the policy of the best row.
    ///
    /// # Errors
    /// An I/O error, or an invalid row.
    pub fn point_best(&self) -> anyhow::Result<()> {
        let Some(best) = self.best_row()? else { return Ok(()) };
        let target = Path::new("../policies").join(format!("{}.safetensors", best.policy_version));
        atomic::replace_link(&self.checkpoints_path().join("best"), &target)
    }

    /// Removes policies that are no longer needed. Keeps those of the best and the latest row,
    /// those in `in_checkpoints`, and every version after the latest row, which is not evaluated
    /// yet.
    ///
    /// # Errors
    /// An I/O error, or an invalid row.
    pub fn prune_policies(&self, in_checkpoints: &[u64]) -> anyhow::Result<()> {
        let (Some(best), Some(latest)) = (self.best_row()?, self.latest_row()?) else {
            return Ok(());
        };
        let is_kept = |version: u64| {
            version >= latest.policy_version
                || version == best.policy_version
                || in_checkpoints.contains(&version)
        };
        for version in self.saved_policies()?.into_iter().filter(|&version| !is_kept(version)) {
            let path = self.policy_path(version);
            match std::fs::remove_file(&path) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(error).with_context(|| format!("cannot remove {}", path.display()));
                }
                _ => {}
            }
        }
        Ok(())
    }
}
