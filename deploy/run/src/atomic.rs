//! Replaces files so that a crash leaves the old or the new content, never a partial file.

use std::fs::{self, File, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::Context;
use tempfile::{Builder, NamedTempFile};

/// Start and end of a temporary file's name.
const PREFIX: &str = ".aside-";
const SUFFIX: &str = ".tmp";
/// Permissions before the umask applies, as for any new file.
const MODE: u32 = 0o666;

/// Replaces a file: writes a temporary file beside it, syncs it and renames it.
///
/// # Errors
/// An I/O error; `path` is then unchanged.
pub fn replace(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let parent = parent_of(path)?;
    let write = || -> std::io::Result<()> {
        let mut file = temporary_file(parent)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(path)?;
        File::open(parent)?.sync_all()
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

/// Replaces a file without syncing it: after a power failure it may be empty.
pub(crate) fn replace_unsynced(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let parent = parent_of(path)?;
    let write = || -> std::io::Result<()> {
        let mut file = temporary_file(parent)?;
        file.write_all(bytes)?;
        file.persist(path)?;
        Ok(())
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

/// Creates a symbolic link from `link` to `target`, or replaces it atomically if it exists.
pub(crate) fn replace_link(link: &Path, target: &Path) -> anyhow::Result<()> {
    let create = || -> anyhow::Result<()> {
        let temporary =
            builder().make_in(parent_of(link)?, |at| std::os::unix::fs::symlink(target, at))?;
        temporary.persist(link)?;
        Ok(())
    };
    create().with_context(|| format!("cannot write {}", link.display()))
}

fn builder() -> Builder<'static, 'static> {
    let mut builder = Builder::new();
    builder.prefix(PREFIX).suffix(SUFFIX);
    builder
}

fn temporary_file(folder: &Path) -> std::io::Result<NamedTempFile> {
    builder().permissions(Permissions::from_mode(MODE)).tempfile_in(folder)
}

fn parent_of(path: &Path) -> anyhow::Result<&Path> {
    let parent = path.parent().with_context(|| format!("{} has no folder", path.display()))?;
    Ok(if parent.as_os_str().is_empty() { Path::new(".") } else { parent })
}

/// Removes the temporary files of killed processes from a folder. No other process may be writing
/// there.
pub(crate) fn remove_temporary_files(folder: &Path) -> anyhow::Result<()> {
    let failed = |path: &Path| format!("cannot remove {}", path.display());
    for entry in fs::read_dir(folder).with_context(|| failed(folder))? {
        let entry = entry.with_context(|| failed(folder))?;
        let path = entry.path();
        // The learner removes half-written checkpoints, which are folders.
        if is_temporary(&entry.file_name().to_string_lossy())
            && (path.is_symlink() || path.is_file())
        {
            fs::remove_file(&path).with_context(|| failed(&path))?;
        }
    }
    Ok(())
}

/// Returns true if a file has the name of a temporary file: `NAME.tmp`, or `NAME.tmp<process id>`
/// of an older version.
fn is_temporary(name: &str) -> bool {
    let after = name.rsplit_once(SUFFIX).map(|(_, after)| after);
    after.is_some_and(|after| after.bytes().all(|byte| byte.is_ascii_digit()))
}
