//! The lease of a run: files `lease.N`, of which the one with the highest number counts.
//!
//! It holds where `flock` does not: between hosts, if the file system's locks are local or absent.
//! The only operation that it relies on is exclusive creation, which is atomic also on network file
//! systems (open(2), `O_EXCL`). A number is created once: whoever creates the next one is the next
//! holder. The file is never released by removing it, because a process that has seen the old one
//! could then create a number below that of a new holder.
//!
//! The holder rewrites its file every [`RENEWAL`]. Others do not compare times, because the clocks
//! of hosts differ: they watch whether the content changes.

use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::holder::Holder;

/// Interval between two renewals.
pub(super) const RENEWAL: Duration = Duration::from_secs(5);
/// Time without a renewal after which the holder counts as dead. It is longer than the 60 s for
/// which an NFS client may show old attributes of a file (`acregmax` in nfs(5)), and longer than a
/// learner needs for its last checkpoint after its supervisor was killed.
pub(super) const TIMEOUT: Duration = Duration::from_secs(90);
/// Start of the files' names.
const PREFIX: &str = "lease.";

/// Content of a lease's file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Content {
    holder: Holder,
    /// Number of renewals, padded: all renewals write the same number of bytes.
    renewals: String,
    /// True once the holder has given up the lock.
    released: bool,
}

/// A lease as found in a run directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct FoundLease {
    pub number: u64,
    /// The whole file, to notice a renewal.
    pub text: String,
    /// `None` if the content cannot be read, as between creating and writing it.
    pub holder: Option<Holder>,
    pub released: bool,
}

/// A lease that this process holds.
#[derive(Debug)]
pub(super) struct Lease {
    run: PathBuf,
    number: u64,
    holder: Holder,
    renewals: u64,
}

/// Result of a renewal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Renewed {
    /// The lease is still this process's.
    Held,
    /// Another process has taken the run over.
    Lost(Option<Holder>),
}

/// Finds the lease that counts; `None` if the run has none.
pub(super) fn newest(run: &Path) -> io::Result<Option<FoundLease>> {
    let Some(number) = numbers(run)?.into_iter().max() else { return Ok(None) };
    let text = match fs::read(path(run, number)) {
        Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
        // Its successor has removed it since the listing, so the next look finds another one.
        Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
        Err(error) => return Err(error),
    };
    let content: Option<Content> = serde_json::from_str(&text).ok();
    let released = content.as_ref().is_some_and(|content| content.released);
    let holder = content.map(|content| content.holder);
    Ok(Some(FoundLease { number, text, holder, released }))
}

impl Lease {
    /// Creates the lease with this number; `None` if another process was faster.
    pub(super) fn claim(run: &Path, number: u64, holder: Holder) -> io::Result<Option<Self>> {
        let file = path(run, number);
        match OpenOptions::new().write(true).create_new(true).mode(0o600).open(&file) {
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::AlreadyExists => return Ok(None),
            Err(error) => return Err(error),
        }
        let lease = Self { run: run.to_owned(), number, holder, renewals: 0 };
        lease.write(false)?;
        // The number may be an old one, which a newer holder has removed since it was found.
        if numbers(run)?.into_iter().any(|other| other > number) {
            fs::remove_file(&file)?;
            return Ok(None);
        }
        for older in numbers(run)?.into_iter().filter(|&other| other < number) {
            // Another process may remove it at the same time; it counts no more.
            let _ = fs::remove_file(path(run, older));
        }
        Ok(Some(lease))
    }

    /// Renews the lease, unless it was lost.
    pub(super) fn renew(&mut self) -> io::Result<Renewed> {
        let newest = newest(&self.run)?;
        if let Some(newer) = newest.filter(|newest| newest.number > self.number) {
            return Ok(Renewed::Lost(newer.holder));
        }
        self.renewals += 1;
        self.write(false)?;
        Ok(Renewed::Held)
    }

    /// Gives up the lease.
    pub(super) fn release(&self) -> io::Result<()> {
        self.write(true)
    }

    fn write(&self, released: bool) -> io::Result<()> {
        let renewals = format!("{:016}", self.renewals);
        let content = Content { holder: self.holder.clone(), renewals, released };
        let mut text = serde_json::to_string(&content)?;
        text.push('\n');
        // Opened each time: closing a file sends its content to the server of a network file
        // system. One write, in place, because all contents are of about the same length.
        let file = path(&self.run, self.number);
        let mut options = OpenOptions::new();
        let mut file = options.write(true).create(true).truncate(false).mode(0o600).open(file)?;
        file.write_all(text.as_bytes())?;
        file.set_len(text.len() as u64)
    }
}

fn path(run: &Path, number: u64) -> PathBuf {
    run.join(format!("{PREFIX}{number}"))
}

/// Returns the numbers of all leases of the run.
fn numbers(run: &Path) -> io::Result<Vec<u64>> {
    let mut numbers = Vec::new();
    for entry in fs::read_dir(run)? {
        let name = entry?.file_name();
        let number = name.to_str().and_then(|name| name.strip_prefix(PREFIX));
        numbers.extend(number.and_then(|number| number.parse::<u64>().ok()));
    }
    Ok(numbers)
}
