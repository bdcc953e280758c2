//! Replacing a file so that a crash leaves either the old or the new one, never a torn one.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use anyhow::Context;

/// Writes `bytes` beside `path`, syncs, and renames over it.
pub(crate) fn replace(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let parent = path.parent().with_context(|| format!("{} has no folder", path.display()))?;
    let parent = if parent.as_os_str().is_empty() { Path::new(".") } else { parent };
    // The process id keeps two writers apart; the rename decides which one stands.
    let aside = path.with_extension(format!("tmp{}", std::process::id()));
    let written = (|| -> std::io::Result<()> {
        let mut file = File::create(&aside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&aside, path)?;
        File::open(parent)?.sync_all()
    })();
    if written.is_err() {
        // The error already on its way says more than a failure to tidy up.
        let _ = fs::remove_file(&aside);
    }
    written.with_context(|| format!("cannot write {}", path.display()))
}

/// The same without a sync: after a crash of the machine the file may be empty.
pub(super) fn replace_unsynced(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let aside = path.with_extension(format!("tmp{}", std::process::id()));
    let written = fs::write(&aside, bytes).and_then(|()| fs::rename(&aside, path));
    if written.is_err() {
        let _ = fs::remove_file(&aside);
    }
    written.with_context(|| format!("cannot write {}", path.display()))
}

/// Makes `link` a symbolic link to `target`, replacing the one that was there in one step.
pub(super) fn point(link: &Path, target: &Path) -> anyhow::Result<()> {
    let aside = link.with_extension(format!("tmp{}", std::process::id()));
    // One that a killed process of this number left behind.
    let _ = fs::remove_file(&aside);
    std::os::unix::fs::symlink(target, &aside)
        .and_then(|()| fs::rename(&aside, link))
        .with_context(|| format!("cannot write {}", link.display()))
}

/// Removes what killed writers left beside the files of a folder; none may be at work there.
pub(super) fn remove_asides(folder: &Path) -> anyhow::Result<()> {
    let failed = |path: &Path| format!("cannot tidy up {}", path.display());
    for entry in fs::read_dir(folder).with_context(|| failed(folder))? {
        let path = entry.with_context(|| failed(folder))?.path();
        let extension = path.extension().unwrap_or_default().to_string_lossy().into_owned();
        let writer = extension.strip_prefix("tmp");
        let is_aside = writer.is_some_and(|id| id.bytes().all(|byte| byte.is_ascii_digit()));
        // Half-written checkpoints are folders, and the next checkpoint's business.
        if is_aside && (path.is_symlink() || path.is_file()) {
            fs::remove_file(&path).with_context(|| failed(&path))?;
        }
    }
    Ok(())
}
