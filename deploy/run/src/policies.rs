//! `policies/<version>.safetensors`: which are kept, and which one a user means.

use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use dmprl_shared::supervision::EvaluationRow;

use crate::atomic;
use crate::directory::RunDirectory;
use crate::failure::wrong_use;

/// Which of a run's saved policies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PolicyChoice {
    /// The one with the highest evaluation return.
    Best,
    /// The last one evaluated.
    Latest,
    /// This one.
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

/// A saved policy, and how it did when the run evaluated it.
#[derive(Debug, Clone, PartialEq)]
pub struct ChosenPolicy {
    /// Its version.
    pub version: u64,
    /// Its file, which exists.
    pub path: PathBuf,
    /// Its row, when there is one.
    pub row: Option<EvaluationRow>,
}

impl RunDirectory {
    /// Where a policy is saved.
    #[must_use]
    pub fn policy_path(&self, version: u64) -> PathBuf {
        self.path().join("policies").join(format!("{version}.safetensors"))
    }

    /// The policy that `choice` means.
    ///
    /// # Errors
    /// Wrong use: nothing evaluated yet, or no such version; the versions there are named.
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
                    "run {} has no evaluation yet, so no {choice} policy; go on with it: \
                     dmprl resume {}",
                    self.path().display(),
                    self.path().display()
                )));
            }
        };
        let path = self.policy_path(version);
        if path.is_file() {
            return Ok(ChosenPolicy { version, path, row });
        }
        let there: Vec<String> = self.saved_policies()?.iter().map(u64::to_string).collect();
        Err(wrong_use(format!(
            "run {} has not kept policy {version}; kept: {}",
            self.path().display(),
            if there.is_empty() { "none".into() } else { there.join(", ") }
        )))
    }

    /// The versions saved.
    ///
    /// # Errors
    /// What the file system refuses.
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

    /// Points `checkpoints/best` at the best row's policy.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn point_best(&self) -> anyhow::Result<()> {
        let Some(best) = self.best_row()? else { return Ok(()) };
        let target = Path::new("../policies").join(format!("{}.safetensors", best.policy_version));
        atomic::point(&self.checkpoints_path().join("best"), &target)
    }

    /// Removes the policies that nothing names any more. Kept are the best and the latest row's,
    /// those in `also` (what the checkpoints name), and every version after the latest row's:
    /// its evaluation is still to come.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn prune_policies(&self, also: &[u64]) -> anyhow::Result<()> {
        let (Some(best), Some(latest)) = (self.best_row()?, self.latest_row()?) else {
            return Ok(());
        };
        let kept = |version: u64| {
            version >= latest.policy_version
                || version == best.policy_version
                || also.contains(&version)
        };
        for version in self.saved_policies()?.into_iter().filter(|&version| !kept(version)) {
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
