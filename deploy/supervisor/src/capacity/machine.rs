//! The limits of this machine, or of the container.

use std::fs;
use std::path::{Path, PathBuf};

use dmprl_run::Machine;
use rustix::process::{Resource, getrlimit};

use crate::Place;

/// Mount point of the control groups.
const CONTROL_GROUPS: &str = "/sys/fs/cgroup";

/// A file system and its free space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Space {
    /// A directory in it.
    pub path: PathBuf,
    /// Total size \[bytes\].
    pub size_bytes: u64,
    /// Space available to this user \[bytes\].
    pub free_bytes: u64,
}

impl Space {
    /// Returns the file system of `path`.
    ///
    /// # Errors
    /// It does not exist, or its size is unavailable.
    pub fn of(path: &Path) -> std::io::Result<Self> {
        let file_system = rustix::fs::statvfs(path)?;
        let bytes = |blocks: u64| blocks.saturating_mul(file_system.f_frsize);
        Ok(Self {
            path: path.to_owned(),
            size_bytes: bytes(file_system.f_blocks),
            free_bytes: bytes(file_system.f_bavail),
        })
    }
}

/// Limits of this machine; `None` means unlimited or unknown.
#[derive(Debug, Clone)]
pub struct MachineLimits {
    /// File system of the runs' shared memory.
    pub shared_memory: Option<Space>,
    /// Open files per process.
    pub open_files: Option<u64>,
    /// Memory maps per process.
    pub maps: Option<u64>,
    /// Processes and threads of this user or container.
    pub tasks: Option<u64>,
    /// Main memory, or the container's limit \[bytes\].
    pub memory_bytes: Option<u64>,
}

impl MachineLimits {
    /// Reads the current limits.
    pub fn this() -> Self {
        let group = |file| control_group_min(Path::new(CONTROL_GROUPS), &own_group(), file);
        let least = |limits: [Option<u64>; 2]| limits.into_iter().flatten().min();
        Self {
            shared_memory: Space::of(Place::of_this_user().base()).ok(),
            open_files: getrlimit(Resource::Nofile).current,
            maps: number(Path::new("/proc/sys/vm/max_map_count")),
            tasks: least([getrlimit(Resource::Nproc).current, group("pids.max")]),
            memory_bytes: least([Machine::this().memory_bytes, group("memory.max")]),
        }
    }
}

/// Returns this process's control group of version 2; empty if there is only version 1.
fn own_group() -> String {
    let text = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let own = text.lines().find_map(|line| line.strip_prefix("0::/"));
    own.unwrap_or_default().to_owned()
}

/// Returns the smallest limit in `file` of the group and its ancestors. The value `max` means no
/// limit. In a container, the process's own group is the root.
fn control_group_min(root: &Path, group: &str, file: &str) -> Option<u64> {
    let own = root.join(group);
    let groups = own.ancestors().take_while(|path| path.starts_with(root));
    groups.filter_map(|path| number(&path.join(file))).min()
}

fn number(path: &Path) -> Option<u64> {
    fs::read_to_string(path).ok()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tightest_of_nested_groups_counts() {
        let root = tempfile::tempdir().unwrap();
        let inner = root.path().join("outer/inner");
        fs::create_dir_all(&inner).unwrap();
        let limit = || control_group_min(root.path(), "outer/inner", "memory.max");
        assert_eq!(limit(), None);
        fs::write(inner.join("memory.max"), "max\n").unwrap();
        assert_eq!(limit(), None);
        fs::write(root.path().join("outer/memory.max"), "2000\n").unwrap();
        assert_eq!(limit(), Some(2_000));
        fs::write(inner.join("memory.max"), "1000\n").unwrap();
        assert_eq!(limit(), Some(1_000));
        assert_eq!(control_group_min(root.path(), "", "memory.max"), None);
    }

    #[test]
    fn this_machine_has_files_and_maps() {
        let this = MachineLimits::this();
        assert!(this.maps.is_some_and(|maps| maps > 0));
        assert!(this.shared_memory.is_some_and(|space| space.size_bytes >= space.free_bytes));
    }
}
