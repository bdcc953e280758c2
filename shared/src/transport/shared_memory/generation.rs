//! Generations: each learner of a run has its own directory, and workers switch to the newest one.
//!
//! ```text
//! <domain>/generation    number of the newest complete generation
//! <domain>/g<number>/    all files of iceoryx2 for one learner and its workers
//! ```
//! iceoryx2 0.10 does not recover from every crash. If a process is killed while it creates a
//! service, processes that open the service hang. If a process is killed during cleanup, some slots
//! are never freed. Therefore a new learner reuses nothing: it removes the old directory, starts in
//! a new one, and announces its number when all services are complete. Workers detect the new
//! number and rejoin.

use std::fs::{DirBuilder, File, OpenOptions};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use iceoryx2::node::Node;
use memmap2::{Mmap, MmapOptions};

use super::channel::Disconnected;
use super::domain::Domain;
use super::service::{self, PrivateIpc, middleware_error};
use crate::transport::TransportError;

const NUMBER_FILE: &str = "generation";
const DIRECTORY_PREFIX: &str = "g";
/// Length that a generation's directory adds to the domain's path: "/g" and four digits [bytes].
pub(super) const DIRECTORY_BYTES: usize = 6;
/// Consecutive failures to join a new generation before the error is returned. Some are normal: the
/// learner may die during the join, or the worker's previous process may still be registered. The
/// limit is high because a learner may be killed just after announcing its generation. No worker
/// can join that generation, and the next one is announced only after the next learner has loaded a
/// checkpoint.
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
    /// Removes all other generations and starts a new one. The caller must hold the learner's lock.
    pub(super) fn begin(domain: &Domain) -> Result<Self, TransportError> {
        let path = domain.path();
        let failed = || middleware_error("starting a generation in", path.display());
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
            .map_err(middleware_error("announcing", self.root.display()))
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

/// The number of the newest generation, memory-mapped because it is read before every segment. A
/// system call would take as long as the rest of sending one.
#[derive(Debug)]
struct NewestNumber(Mmap);

impl NewestNumber {
    /// Opens the number. Fails if no learner has served the domain yet.
    fn open(domain: &Path) -> Result<Self, TransportError> {
        let operation = "finding a learner in";
        let file = File::open(domain.join(NUMBER_FILE));
        let file = file.map_err(middleware_error(operation, domain.display()))?;
        // Before the first announcement the file is empty and cannot be mapped.
        let served = read_number(&file).ok_or("no learner has served it yet");
        served.map_err(middleware_error(operation, domain.display()))?;
        // SAFETY: the file has these bytes. No process of the run truncates it and no other user
        // can, so the mapping stays valid. `get` handles concurrent changes.
        let map = unsafe { MmapOptions::new().len(size_of::<u64>()).map(&file) };
        Ok(Self(map.map_err(middleware_error("mapping a file of", domain.display()))?))
    }

    fn get(&self) -> u64 {
        // SAFETY: a mapping starts at a page boundary, so its first eight bytes are aligned, and
        // every bit pattern is a valid number. The read is volatile because a learner writes the
        // number concurrently, with a single store.
        u64::from_le(unsafe { self.0.as_ptr().cast::<u64>().read_volatile() })
    }
}

/// A port `P` of a worker, which it recreates for each new generation.
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

    /// Number of the generation that the worker has joined or last tried to join.
    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Recreates the port if there is a new generation or a connection failed. Returns whether it
    /// did.
    ///
    /// # Errors
    /// `Incompatible` immediately. Other errors only if they persist.
    pub(super) fn renew(
        &mut self,
        make: impl FnOnce(&Node<PrivateIpc>, &Disconnected) -> Result<P, TransportError>,
    ) -> Result<bool, TransportError> {
        // Checked before each segment, so that none is sent to the queue of a replaced learner.
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
        // Drops the old port first, because the slot allows only one.
        self.port = None;
        self.disconnected.clear();
        self.number = self.newest.get();
        let node = service::join(&root(&self.domain, self.number))?;
        self.port = Some(make(&node, &self.disconnected)?);
        Ok(())
    }
}
