//! Names of checkpoints, the link `latest`, and the deletion of the oldest.

use std::fs;
use std::path::Path;

use super::{CheckpointError, io_error};

const LATEST: &str = "latest";

/// Returns the names of a folder's complete checkpoints, oldest first.
///
/// # Errors
/// If the folder cannot be read.
pub fn names(folder: &Path) -> Result<Vec<String>, CheckpointError> {
    dmprl_shared::checkpoint::names(folder).map_err(io_error(folder))
}

/// Returns the name of the next checkpoint.
pub(super) fn next_name(folder: &Path) -> Result<String, CheckpointError> {
    let newest = names(folder)?.last().and_then(|name| name.parse::<u64>().ok()).unwrap_or(0);
    Ok(format!("{:06}", newest + 1))
}

/// Deletes the partial checkpoints and the partial link of a killed writer. Other processes write
/// the other temporary files in the folder, such as the evaluator's link to the best policy.
pub(super) fn remove_temporaries(folder: &Path) -> Result<(), CheckpointError> {
    for entry in fs::read_dir(folder).map_err(io_error(folder))? {
        let path = entry.map_err(io_error(folder))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let stem = name.strip_prefix('.').and_then(|name| name.strip_suffix(".tmp"));
        let is_ours = |stem: &str| stem == LATEST || stem.parse::<u64>().is_ok();
        if stem.is_some_and(is_ours) {
            let removed =
                if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            removed.map_err(io_error(&path))?;
        }
    }
    Ok(())
}

/// Points `latest` at a checkpoint, atomically.
pub(super) fn point_latest(folder: &Path, name: &str) -> Result<(), CheckpointError> {
    let temporary = folder.join(".latest.tmp");
    let link = folder.join(LATEST);
    // In a copy made without symbolic links, `latest` is a directory.
    if link.symlink_metadata().is_ok_and(|there| there.is_dir()) {
        fs::remove_dir_all(&link).map_err(io_error(&link))?;
    }
    std::os::unix::fs::symlink(name, &temporary)
        .and_then(|()| fs::rename(&temporary, &link))
        .and_then(|()| fs::File::open(folder)?.sync_all())
        .map_err(io_error(&link))
}

/// Deletes the oldest checkpoints until at most `keep` remain with at most `bytes_max` in total.
/// The newest always stays.
pub(super) fn rotate(folder: &Path, keep: usize, bytes_max: u64) -> Result<(), CheckpointError> {
    let names = names(folder)?;
    let sizes: Vec<u64> =
        names.iter().map(|name| size(&folder.join(name))).collect::<Result<_, _>>()?;
    let mut bytes_so_far = 0;
    for (age, (name, bytes)) in names.iter().zip(sizes).rev().enumerate() {
        bytes_so_far += bytes;
        if age > 0 && (age >= keep || bytes_so_far > bytes_max) {
            let path = folder.join(name);
            fs::remove_dir_all(&path).map_err(io_error(&path))?;
        }
    }
    Ok(())
}

fn size(checkpoint: &Path) -> Result<u64, CheckpointError> {
    let mut bytes = 0;
    for entry in fs::read_dir(checkpoint).map_err(io_error(checkpoint))? {
        let metadata = entry.and_then(|entry| entry.metadata()).map_err(io_error(checkpoint))?;
        bytes += metadata.len();
    }
    Ok(bytes)
}
