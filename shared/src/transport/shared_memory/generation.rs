//! A directory of its own for each learner of a run, and how workers follow from one to the next.
//!
//! ```text
//! <domain>/generation    number of the newest complete generation
//! <domain>/g<number>/    all that iceoryx2 creates for one learner and its workers
//! ```
//! iceoryx2 0.10 does not recover from every death: a creator killed in the middle leaves a
//! service that hangs, a cleaner killed in the middle leaves places taken for good. So a new
//! learner inherits nothing. It starts in a new directory, removes the old one, and announces its
//! number when all services are complete; workers notice the number and join anew.

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
/// Bytes that the directory adds to the domain's path: "/g" and four digits.
pub(super) const DIRECTORY_BYTES: usize = 6;
/// Failures in a row to join a new generation before the caller is told. A few are normal: the
/// learner may die again in that moment, or its predecessor's worker be still registered. Many,
/// because a learner killed between announcing its generation and the worker's look leaves one that
/// nobody can join until the next is announced, which takes as long as a checkpoint takes to load.
const JOIN_FAILURES_MAX: usize = 100_000;

/// A generation that is being made; workers do not see it yet.
#[derive(Debug)]
pub(super) struct Generation {
    /// Counts the learners of the domain, from 1.
    pub(super) number: u64,
    number_file: File,
    /// Its directory.
    pub(super) root: PathBuf,
}

impl Generation {
    /// Starts a new generation and removes all others. Only for the holder of the learner's lock.
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

    /// Whether no learner has served the domain before.
    pub(super) fn is_first(&self) -> bool {
        self.number == 1
    }

    /// Tells the workers that it is complete.
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

/// The number of the newest generation, mapped: it is looked at before every segment, and a system
/// call would take as long as all the rest of sending one.
#[derive(Debug)]
struct NewestNumber(Mmap);

impl NewestNumber {
    /// Of a domain that a learner has served.
    fn open(domain: &Path) -> Result<Self, TransportError> {
        let operation = "looking for a learner in";
        let file = File::open(domain.join(NUMBER_FILE));
        let file = file.map_err(refused(operation, domain.display()))?;
        // Before the first announcement there is nothing to map.
        let served = read_number(&file).ok_or("none has served it yet");
        served.map_err(refused(operation, domain.display()))?;
        // SAFETY: the file has these bytes and no process of the run shortens it, nor can another
        // user, so none of them goes away below the map; that they change is looked at in `get`.
        let map = unsafe { MmapOptions::new().len(size_of::<u64>()).map(&file) };
        Ok(Self(map.map_err(refused("mapping a file of", domain.display()))?))
    }

    fn get(&self) -> u64 {
        // SAFETY: a map begins at a page, so eight bytes at its start are aligned, and every
        // pattern is a number. Volatile, because a learner writes them: with one store, as here is
        // one load.
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

    /// The port, if there is one at the moment.
    pub(super) fn port(&self) -> Option<&P> {
        self.port.as_ref()
    }

    /// The generation it has joined, or last tried to.
    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Makes the port anew if there is a new generation or a connection failed; true if it did.
    ///
    /// # Errors
    /// `Incompatible` at once, others when they persist.
    pub(super) fn renew(
        &mut self,
        make: impl FnOnce(&Node<PrivateIpc>, &Disconnected) -> Result<P, TransportError>,
    ) -> Result<bool, TransportError> {
        // So that nothing is delivered to a dead learner's queue while the next learner waits.
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
        // First, because the slot has one place only.
        self.port = None;
        self.disconnected.clear();
        self.number = self.newest.get();
        let node = service::join(&root(&self.domain, self.number))?;
        self.port = Some(make(&node, &self.disconnected)?);
        Ok(())
    }
}
