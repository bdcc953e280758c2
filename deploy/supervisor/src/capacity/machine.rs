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
        let memberships = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
        let group = |limit: GroupLimit| limit.least(Path::new(CONTROL_GROUPS), &memberships);
        let least = |limits: [Option<u64>; 2]| limits.into_iter().flatten().min();
        Self {
            shared_memory: Space::of(Place::of_this_user().base()).ok(),
            open_files: getrlimit(Resource::Nofile).current,
            maps: number(Path::new("/proc/sys/vm/max_map_count")),
            tasks: least([getrlimit(Resource::Nproc).current, group(TASKS)]),
            memory_bytes: least([Machine::this().memory_bytes, group(MEMORY)]),
        }
    }
}

/// A limit of a control group: the names of its files in versions 2 and 1 of control groups.
struct GroupLimit {
    /// Controller of version 1, which is also the name of its mount point.
    controller: &'static str,
    /// File of version 2.
    file: &'static str,
    /// File of version 1.
    file_of_version_1: &'static str,
}

const TASKS: GroupLimit =
    GroupLimit { controller: "pids", file: "pids.max", file_of_version_1: "pids.max" };
const MEMORY: GroupLimit = GroupLimit {
    controller: "memory",
    file: "memory.max",
    file_of_version_1: "memory.limit_in_bytes",
};

/// Limits from here on are none. Version 1 writes "no limit" as the largest multiple of the page
/// size.
const UNLIMITED_FROM: u64 = 1 << 62;

impl GroupLimit {
    /// Returns the smallest limit of this process's control groups, below the mount points in
    /// `root`. `memberships` is the text of `/proc/self/cgroup`.
    fn least(&self, root: &Path, memberships: &str) -> Option<u64> {
        let limits = memberships.lines().filter_map(|line| {
            let mut fields = line.splitn(3, ':').skip(1);
            let (controllers, group) = (fields.next()?, fields.next()?.trim_start_matches('/'));
            if controllers.is_empty() {
                return control_group_min(root, group, self.file);
            }
            let has_it = controllers.split(',').any(|name| name == self.controller);
            let mount = root.join(self.controller);
            has_it.then(|| control_group_min(&mount, group, self.file_of_version_1))?
        });
        limits.filter(|limit| *limit < UNLIMITED_FROM).min()
    }
}

/// Returns the smallest limit in `file` of the group and its ancestors. The value `max` means no
/// limit. In a container, the process's own group is the root, whatever its name outside.
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
    fn limits_of_both_versions_of_control_groups_count() {
        let root = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        let (memory, tasks) = ("5:memory:/slurm/job_7", "3:cpu,pids:/slurm/job_7");
        let hybrid = format!("{memory}\n{tasks}\n0::/user.slice\n");
        let limits =
            |memberships: &str| [MEMORY, TASKS].map(|limit| limit.least(root.path(), memberships));
        assert_eq!(limits(&hybrid), [None, None]);
        write("memory/slurm/memory.limit_in_bytes", "9223372036854771712\n");
        assert_eq!(limits(&hybrid), [None, None], "the value for no limit");
        write("memory/slurm/job_7/memory.limit_in_bytes", "8000\n");
        write("pids/slurm/pids.max", "512\n");
        write("pids/slurm/job_7/pids.max", "max\n");
        assert_eq!(limits(&hybrid), [Some(8_000), Some(512)]);
        write("user.slice/memory.max", "7000\n");
        assert_eq!(limits(&hybrid), [Some(7_000), Some(512)]);
        assert_eq!(limits("0::/\n"), [None, None], "version 2 alone ignores the others");
    }

    #[test]
    fn this_machine_has_files_and_maps() {
        let this = MachineLimits::this();
        assert!(this.maps.is_some_and(|maps| maps > 0));
        assert!(this.shared_memory.is_some_and(|space| space.size_bytes >= space.free_bytes));
    }
}
