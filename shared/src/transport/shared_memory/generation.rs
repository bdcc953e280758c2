//! A separate directory for each learner of a run, and the workers' switch from one to the next.
//!
//! ```text
//! <domain>/generation    number of the newest complete generation
//! <domain>/g<number>/    all that iceoryx2 creates for one learner and its workers
//! ```
//! iceoryx2 0.10 does not recover from every death: a process killed while creating a service
//! leaves one that hangs, and a process killed during cleanup leaves slots that are never freed.
//! Therefore a new learner inherits nothing. It starts in a new directory, removes the old one, and
//! announces its number when all services are complete. Workers detect the new number and rejoin.

use std::fs::{DirBuilder, File, OpenOptions};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use iceoryx2::node::Node;
use memmap2::{Mmap, MmapOptions};

use super::channel::Disconnected;
use super::domain::Domain;
use super::service::{self, PrivateIpc, refused};
use crate::transport::TransportError;

const NUMBER_FILE: &str = "generation";
const DIRECTORY_PREFIX: &str = "g";
/// Length that the directory adds to the domain's path: "/g" and four digits [bytes].
pub(super) const DIRECTORY_BYTES: usize = 6;
/// Consecutive failures to join a new generation before the error is returned. A few are normal:
/// the learner may die again during the join, or the predecessor's worker may still be registered.
/// The limit is high because a learner may be killed just after announcing its generation. No
/// worker can join that generation, and the next one is announced only after a checkpoint has been
/// loaded.
const JOIN_FAILURES_MAX: usize = 100_000;

/// A generation under construction, which workers do not see yet.
#[derive(Debug)]
pub(super) struct Generation {
    /// Number of the learner within the domain, from 1.
    pub(super) number: u64,
    number_file: File,
    /// Directory of the generation.
    pub(super) root: PathBuf,
}

impl Generation {
    /// Starts a new generation and removes all others. The caller must hold the learner's lock.
    pub(super) fn begin(domain: &Domain) -> Result<Self, TransportError> {
        let path = domain.path();
        let failed = || refused("starting a generation in", path.display());
        for entry in path.read_dir().map_err(failed())? {
            let entry = entry.map_err(failed())?;
            let named = entry.file_name().as_bytes().starts_with(DIRECTORY_PREFIX.as_bytes());
            if named && entry.file_type().map_err(failed())?.is_dir() {
                std::fs::remove_dir_all(entry.path()).map_err(failed())?;
            }
        }
        let number_file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(path.join(NUMBER_FILE))
            .map_err(failed())?;
        let number = read_number(&number_file).unwrap_or(0) + 1;
        let root = root(path, number);
        DirBuilder::new().mode(0o700).create(&root).map_err(failed())?;
        service::write_config(&root)?;
        Ok(Self { number, number_file, root })
    }

    /// Whether this is the domain's first learner.
    pub(super) fn is_first(&self) -> bool {
        self.number == 1
    }

    /// Announces to the workers that the generation is complete.
    pub(super) fn announce(self) -> Result<(), TransportError> {
        self.number_file
            .write_all_at(&self.number.to_le_bytes(), 0)
            .map_err(refused("announcing", self.root.display()))
    }
}

fn root(domain: &Path, number: u64) -> PathBuf {
    domain.join(format!("{DIRECTORY_PREFIX}{number}"))
}

fn read_number(file: &File) -> Option<u64> {
    let mut bytes = [0; size_of::<u64>()];
    file.read_exact_at(&mut bytes, 0).ok()?;
    Some(u64::from_le_bytes(bytes))
}

/// The number of the newest generation, memory-mapped: it is read before every segment, and a
/// system call would take as long as the rest of sending one.
#[derive(Debug)]
struct NewestNumber(Mmap);

impl NewestNumber {
    /// Opens the number of a domain that a learner has served.
    fn open(domain: &Path) -> Result<Self, TransportError> {
        let operation = "looking for a learner in";
        let file = File::open(domain.join(NUMBER_FILE));
        let file = file.map_err(refused(operation, domain.display()))?;
        // Before the first announcement the file is empty and cannot be mapped.
        let served = read_number(&file).ok_or("none has served it yet");
        served.map_err(refused(operation, domain.display()))?;
        // SAFETY: the file has these bytes. No process of the run truncates it and no other user
        // can, so the mapping stays valid. `get` handles concurrent changes.
        let map = unsafe { MmapOptions::new().len(size_of::<u64>()).map(&file) };
        Ok(Self(map.map_err(refused("mapping a file of", domain.display()))?))
    }

    fn get(&self) -> u64 {
        // SAFETY: a mapping starts at a page boundary, so its first eight bytes are aligned, and
        // every bit pattern is a valid number. The read is volatile because a learner writes the
        // number concurrently, with a single store.
        u64::from_le(unsafe { self.0.as_ptr().cast::<u64>().read_volatile() })
    }
}

/// A worker's port `P` to the newest generation.
#[derive(Debug)]
pub(super) struct Membership<P> {
    domain: PathBuf,
    newest: NewestNumber,
    number: u64,
    /// `None` between two generations.
    port: Option<P>,
    disconnected: Disconnected,
    failures: usize,
}

impl<P> Membership<P> {
    /// Joins the newest generation of a domain.
    pub(super) fn new(
        domain: &Domain,
        make: impl FnOnce(&Node<PrivateIpc>, &Disconnected) -> Result<P, TransportError>,
    ) -> Result<Self, TransportError> {
        let domain = domain.path().to_owned();
        let newest = NewestNumber::open(&domain)?;
        let disconnected = Disconnected::default();
        let mut membership =
            Self { domain, newest, number: 0, port: None, disconnected, failures: 0 };
        membership.join(make)?;
        Ok(membership)
    }

    /// The port, or `None` between two generations.
    pub(super) fn port(&self) -> Option<&P> {
        self.port.as_ref()
    }

    /// Number of the generation that it has joined or last tried to join.
    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Recreates the port if there is a new generation or a connection failed. Returns true if it
    /// did.
    ///
    /// # Errors
    /// `Incompatible` immediately; other errors if they persist.
    pub(super) fn renew(
        &mut self,
        make: impl FnOnce(&Node<PrivateIpc>, &Disconnected) -> Result<P, TransportError>,
    ) -> Result<bool, TransportError> {
        // This avoids deliveries to a dead learner's queue while the next learner waits.
        let is_current = self.newest.get() == self.number;
        if is_current && self.port.is_some() && !self.disconnected.is_set() {
            return Ok(false);
        }
        match self.join(make) {
            Ok(()) => self.failures = 0,
            Err(error @ TransportError::Incompatible { .. }) => return Err(error),
            Err(error) if self.failures >= JOIN_FAILURES_MAX => return Err(error),
            Err(_) => self.failures += 1,
        }
        Ok(self.port.is_some())
    }

    fn join(
        &mut self,
        make: impl FnOnce(&Node<PrivateIpc>, &Disconnected) -> Result<P, TransportError>,
    ) -> Result<(), TransportError> {
        // The old port goes first, because the slot allows only one.
        self.port = None;
        self.disconnected.clear();
        self.number = self.newest.get();
        let node = service::join(&root(&self.domain, self.number))?;
        self.port = Some(make(&node, &self.disconnected)?);
        Ok(())
    }
}
