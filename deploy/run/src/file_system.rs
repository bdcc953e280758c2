//! The file system of a run directory, and its limits.

use std::fmt::{self, Display, Formatter};
use std::io;
use std::path::Path;

use crate::lock::LEASE_TIMEOUT;

/// Which machines see a file system, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A disk of this machine.
    Local,
    /// Memory of this machine.
    Memory,
    /// Shared by several hosts.
    Network,
    /// A program or a virtual machine's host, so anything may be behind it.
    Forwarded,
}

/// File systems by the number that statfs(2) returns for them (`linux/magic.h`, and the sources of
/// those that are not part of Linux).
const KNOWN: [(u32, &str, Kind); 23] = [
    (0x6969, "nfs", Kind::Network),
    (0xff53_4d42, "cifs", Kind::Network),
    (0xfe53_4d42, "smb2", Kind::Network),
    (0x517b, "smb", Kind::Network),
    (0x0bd0_0bd0, "lustre", Kind::Network),
    (0x4750_4653, "gpfs", Kind::Network),
    (0x1983_0326, "beegfs", Kind::Network),
    (0x00c3_6400, "ceph", Kind::Network),
    (0x5346_414f, "afs", Kind::Network),
    (0x6b41_4653, "afs", Kind::Network),
    (0x7461_636f, "ocfs2", Kind::Network),
    (0x0116_1970, "gfs2", Kind::Network),
    (0x2003_0528, "orangefs", Kind::Network),
    (0xaad7_aaea, "panfs", Kind::Network),
    (0x6573_5546, "fuse", Kind::Forwarded),
    (0x0102_1997, "9p", Kind::Forwarded),
    (0x0102_1994, "tmpfs", Kind::Memory),
    (0x8584_58f6, "ramfs", Kind::Memory),
    (0x794c_7630, "overlay", Kind::Local),
    (0xef53, "ext4", Kind::Local),
    (0x5846_5342, "xfs", Kind::Local),
    (0x9123_683e, "btrfs", Kind::Local),
    (0x2fc1_2fc1, "zfs", Kind::Local),
];

/// A file system.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileSystem {
    name: String,
    kind: Kind,
}

impl FileSystem {
    /// Returns the file system of an existing path.
    ///
    /// # Errors
    /// The path does not exist, or cannot be reached.
    pub fn of(path: &Path) -> io::Result<Self> {
        // The field is signed on some platforms; the numbers have 32 bits.
        Ok(Self::from_number(rustix::fs::statfs(path)?.f_type as u32))
    }

    fn from_number(number: u32) -> Self {
        let known = KNOWN.iter().find(|(known, ..)| *known == number);
        known.map_or_else(
            || Self { name: format!("file system {number:#x}"), kind: Kind::Local },
            |(_, name, kind)| Self { name: (*name).to_owned(), kind: *kind },
        )
    }

    /// Describes what it cannot promise; `None` if it has no such limits.
    #[must_use]
    pub fn concern(&self) -> Option<String> {
        let takeover = format!(
            "a second trainer on another host is refused by the run's lease, and a crashed one is \
             replaced after {} s",
            LEASE_TIMEOUT.as_secs()
        );
        match self.kind {
            Kind::Local => None,
            Kind::Memory => Some("runs in memory are gone after a restart of the machine".into()),
            Kind::Network => Some(format!(
                "file locks may hold only within a host: {takeover}. Other hosts may see new files \
                 some seconds later"
            )),
            Kind::Forwarded => Some(format!(
                "it forwards to another file system, whose locks and links may be missing: \
                 {takeover}"
            )),
        }
    }
}

impl Display for FileSystem {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn network_file_systems_are_named_with_what_they_cannot_promise() {
        for (number, name) in [(0x6969, "nfs"), (0x0bd0_0bd0, "lustre"), (0x6573_5546, "fuse")] {
            let found = FileSystem::from_number(number);
            assert_eq!(found.to_string(), name);
            assert!(found.concern().unwrap().contains("90 s"), "{found:?}");
        }
        assert_eq!(FileSystem::from_number(0xef53).concern(), None);
        let unknown = FileSystem::from_number(0x1234);
        assert_eq!((&*unknown.to_string(), unknown.concern()), ("file system 0x1234", None));
        assert!(FileSystem::of(Path::new("/proc")).is_ok());
        assert!(FileSystem::of(Path::new("/nowhere")).is_err());
    }
}
