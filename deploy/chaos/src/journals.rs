//! Reads a run's journals while they are written, and removes those of dead processes.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::violations::Violations;
use crate::journal::{Author, RECORD_BYTES, Record};

/// The journals in a folder. Those of dead processes are removed once they have been read, so that
/// the folder only holds unread records and the journals of live processes.
pub(super) struct Journals {
    folder: PathBuf,
    open: BTreeMap<Author, Tail>,
    /// Journals of dead processes that have been read completely but are kept.
    read: BTreeSet<Author>,
    /// If true, no journal is removed, so that the user can read them.
    keep: bool,
}

/// A journal that may grow.
struct Tail {
    file: File,
    /// Bytes of an incomplete record.
    rest: Vec<u8>,
    records: Vec<Record>,
    /// Number of invalid records.
    damaged: u64,
}

impl Tail {
    fn open(path: &Path) -> anyhow::Result<Self> {
        let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(Self { file, rest: Vec::new(), records: Vec::new(), damaged: 0 })
    }

    fn read(&mut self) -> std::io::Result<()> {
        self.file.read_to_end(&mut self.rest)?;
        let (whole, _) = self.rest.as_chunks::<RECORD_BYTES>();
        for bytes in whole {
            match Record::decode(bytes) {
                Some(record) => self.records.push(record),
                None => self.damaged += 1,
            }
        }
        let read = whole.len() * RECORD_BYTES;
        self.rest.drain(..read);
        Ok(())
    }
}

impl Journals {
    pub(super) fn new(folder: PathBuf) -> Self {
        Self { folder, open: BTreeMap::new(), read: BTreeSet::new(), keep: false }
    }

    /// Keeps the files from now on.
    pub(super) fn keep(&mut self) {
        self.keep = true;
    }

    /// Passes on all new records, first those of the workers, to which the learners' records refer.
    pub(super) fn fold(
        &mut self,
        violations: &mut Violations,
        mut each: impl FnMut(Author, &Record),
    ) -> anyhow::Result<()> {
        // The workers logged the segments before the learner inserted them. So read the learners'
        // journals first, and the workers' afterwards.
        let learners = self.read(|author| matches!(author, Author::Learner(_)))?;
        let workers = self.read(|author| matches!(author, Author::Worker(..)))?;
        for author in workers.into_iter().chain(learners) {
            let Some(tail) = self.open.get_mut(&author) else { continue };
            tail.records.drain(..).for_each(|record| each(author, &record));
            let damaged = std::mem::take(&mut tail.damaged);
            if damaged > 0 {
                violations.add(format!("I9: {damaged} records of {author:?} are damaged"));
            }
        }
        self.remove_read();
        Ok(())
    }

    /// Reads the journals of some authors; returns the authors in order.
    fn read(&mut self, whose: impl Fn(&Author) -> bool) -> anyhow::Result<Vec<Author>> {
        let failed = || format!("cannot read the journals in {}", self.folder.display());
        let mut authors = Vec::new();
        for entry in fs::read_dir(&self.folder).with_context(failed)? {
            let name = entry.with_context(failed)?.file_name();
            let author = name.to_str().and_then(Author::of).filter(&whose);
            authors.extend(author.filter(|author| !self.read.contains(author)));
        }
        authors.sort_unstable();
        // In reverse order: if a successor's journal has records, its predecessor is dead, so the
        // predecessor's journal is complete when it is read next.
        for author in authors.iter().rev() {
            let tail = match self.open.entry(*author) {
                std::collections::btree_map::Entry::Occupied(open) => open.into_mut(),
                std::collections::btree_map::Entry::Vacant(place) => {
                    place.insert(Tail::open(&author.path(&self.folder))?)
                }
            };
            tail.read().with_context(|| format!("cannot read the journal of {author:?}"))?;
        }
        Ok(authors)
    }

    /// Closes journals whose successor existed before their last read, and removes them unless they
    /// are to be kept.
    fn remove_read(&mut self) {
        let authors: Vec<Author> = self.open.keys().copied().collect();
        for pair in authors.windows(2) {
            let succeeded = match (pair[0], pair[1]) {
                (Author::Worker(one, _), Author::Worker(other, _)) => one == other,
                (Author::Learner(_), Author::Learner(_)) => true,
                _ => false,
            };
            if succeeded {
                self.open.remove(&pair[0]);
                if self.keep {
                    self.read.insert(pair[0]);
                } else {
                    // On failure it is removed with the folder.
                    let _ = fs::remove_file(pair[0].path(&self.folder));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use dmprl_shared::transport::delivery::Watermark;

    use super::*;
    use crate::journal::{Entry, Journal};

    fn journal(folder: &Path, author: Author) -> Journal {
        Journal::open(Some(folder), author).unwrap().unwrap()
    }

    fn acknowledged(sequence: u64) -> Entry {
        Entry::Acknowledged(Watermark { incarnation: 0, sequence })
    }

    fn fold(journals: &mut Journals) -> (Vec<(Author, Entry)>, Violations) {
        let (mut found, mut violations) = (Vec::new(), Violations::default());
        let each = |author, record: &Record| found.push((author, record.entry));
        journals.fold(&mut violations, each).unwrap();
        (found, violations)
    }

    #[test]
    fn records_come_once_workers_first_and_the_journals_of_the_dead_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (Author::Worker(0, 9), Author::Worker(0, 10));
        let learner = journal(folder.path(), Author::Learner(0));
        let worker = journal(folder.path(), first);
        let mut journals = Journals::new(folder.path().to_owned());
        learner.note(Entry::Serving);
        worker.note(acknowledged(1));
        let expected = [(first, acknowledged(1)), (Author::Learner(0), Entry::Serving)];
        assert_eq!(fold(&mut journals).0, expected);
        assert_eq!(fold(&mut journals).0, []);
        worker.note(acknowledged(2));
        journal(folder.path(), second).note(acknowledged(3));
        assert_eq!(fold(&mut journals).0, [(first, acknowledged(2)), (second, acknowledged(3))]);
        assert!(!first.path(folder.path()).exists() && second.path(folder.path()).exists());
    }

    #[test]
    fn a_torn_record_is_waited_for_and_a_damaged_one_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let author = Author::Learner(0);
        let record = Record { entry: Entry::Serving, time_us: 1 }.encode();
        let mut file = File::create(author.path(folder.path())).unwrap();
        let mut journals = Journals::new(folder.path().to_owned());
        file.write_all(&record[..50]).unwrap();
        let (found, violations) = fold(&mut journals);
        assert!(found.is_empty() && violations.is_empty());
        file.write_all(&record[50..]).unwrap();
        assert_eq!(fold(&mut journals).0, [(author, Entry::Serving)]);
        let mut damaged = record;
        damaged[0] ^= 1;
        file.write_all(&damaged).unwrap();
        let (found, violations) = fold(&mut journals);
        assert_eq!((found.len(), violations.count()), (0, 1));
    }
}
