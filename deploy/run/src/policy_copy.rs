//! Copies of a trained policy from elsewhere: run directories without a checkpoint.
//!
//! The original is a folder with the files of a run directory that a policy needs, as in the zoo of
//! the Python package. A copy also has the folders into which commands write logs, videos and
//! plots.

use std::fs;
use std::path::Path;

use anyhow::Context;

use crate::directory::{FOLDERS, RunDirectory};

/// Names the origin of a copy, which `resume` must not start again from the beginning.
const MARK: &str = "copied-from.txt";
/// Files of a policy, beside its folder `policies`.
const FILES: [&str; 4] = ["config.toml", "spec.json", "evaluations.jsonl", "manifest.json"];

impl RunDirectory {
    /// Returns the origin of a copy, such as `zoo:panda-push`; `None` if the run is no
    /// copy.
    #[must_use]
    pub fn copied_from(&self) -> Option<String> {
        let origin = fs::read_to_string(self.path().join(MARK)).ok()?;
        Some(origin.trim_end().to_owned())
    }

    /// Copies the files of a policy to `place`, in one step. If another command has created `place`
    /// in the meantime, it remains.
    ///
    /// - `origin`: where the policy is from, for [`RunDirectory::copied_from`].
    ///
    /// # Errors
    /// An I/O error.
    pub fn copy_policy(&self, origin: &str, place: &Path) -> anyhow::Result<()> {
        let parent = place.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new("."));
        fs::create_dir_all(parent)?;
        let folder = tempfile::Builder::new().prefix(".copy-").tempdir_in(parent)?;
        for name in FOLDERS {
            fs::create_dir(folder.path().join(name))?;
        }
        fs::File::create_new(folder.path().join("metrics.jsonl"))?;
        fs::write(folder.path().join(MARK), format!("{origin}\n"))?;
        for file in FILES {
            fs::copy(self.path().join(file), folder.path().join(file)).context(file)?;
        }
        let policies = self.path().join("policies");
        for entry in policies.read_dir()? {
            let name = entry?.file_name();
            fs::copy(policies.join(&name), folder.path().join("policies").join(&name))?;
        }
        Self::open(folder.path())?.point_best()?;
        // As a run directory of `train`, it is readable for others if the umask allows it.
        let mode = fs::metadata(folder.path().join("policies"))?.permissions();
        fs::set_permissions(folder.path(), mode)?;
        match fs::rename(folder.path(), place) {
            Ok(()) => {
                // It has another name now, so nothing is left to remove.
                let _ = folder.keep();
                Ok(())
            }
            // Another command was faster.
            Err(_) if place.exists() => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}
