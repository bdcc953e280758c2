//! Reads a run's journals as they grow, and removes those of dead processes.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::violations::Violations;
use crate::journal::{Author, RECORD_BYTES, Record};

/// The journals in a folder. Those of dead processes are removed once they have been read, which
/// limits the space on disk.
pub(super) struct Journals {
    folder: PathBuf,
    open: BTreeMap<Author, JournalReader>,
    /// Journals of dead processes that are kept although they have been read completely.
    finished: BTreeSet<Author>,
    /// Keeps all journals for the user.
    keep: bool,
}

/// Reads the records of a growing journal.
struct JournalReader {
    file: File,
    /// Bytes of the last, incomplete record.
    partial: Vec<u8>,
    records: Vec<Record>,
    /// Number of invalid records.
    damaged: u64,
}

impl JournalReader {
    fn open(path: &Path) -> anyhow::Result<Self> {
        let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(Self { file, partial: Vec::new(), records: Vec::new(), damaged: 0 })
    }

    fn read(&mut self) -> std::io::Result<()> {
        self.file.read_to_end(&mut self.partial)?;
        let (whole, _) = self.partial.as_chunks::<RECORD_BYTES>();
        for bytes in whole {
            match Record::decode(bytes) {
                Some(record) => self.records.push(record),
                None => self.damaged += 1,
            }
        }
        let read = whole.len() * RECORD_BYTES;
        self.partial.drain(..read);
        Ok(())
    }
}

impl Journals {
    pub(super) fn new(folder: PathBuf) -> Self {
        Self { folder, open: BTreeMap::new(), finished: BTreeSet::new(), keep: false }
    }

    /// Stops the removal of journals.
    pub(super) fn keep(&mut self) {
        self.keep = true;
    }

    /// Calls `each` with every new record. Those of the workers come first, because the learners'
    /// records refer to them.
    pub(super) fn for_each_new(
        &mut self,
        violations: &mut Violations,
        mut each: impl FnMut(Author, &Record),
    ) -> anyhow::Result<()> {
        // A worker logs a segment before the learner inserts it. Reading the learners' journals
        // first therefore ensures that the workers' records of these segments are read too.
        let learners = self.read(|author| matches!(author, Author::Learner(_)))?;
        let workers = self.read(|author| matches!(author, Author::Worker(..)))?;
        for author in workers.into_iter().chain(learners) {
            let Some(reader) = self.open.get_mut(&author) else { continue };
            reader.records.drain(..).for_each(|record| each(author, &record));
            let damaged = std::mem::take(&mut reader.damaged);
            if damaged > 0 {
                violations.add(format!("I9: {damaged} records of {author:?} are damaged"));
            }
        }
        self.remove_finished();
        Ok(())
    }

    /// Reads the journals of the selected authors. Returns these authors in order.
    fn read(&mut self, is_selected: impl Fn(&Author) -> bool) -> anyhow::Result<Vec<Author>> {
        let failed = || format!("cannot read the journals in {}", self.folder.display());
        let mut authors = Vec::new();
        for entry in fs::read_dir(&self.folder).with_context(failed)? {
            let name = entry.with_context(failed)?.file_name();
            let author = name.to_str().and_then(Author::of).filter(&is_selected);
            authors.extend(author.filter(|author| !self.finished.contains(author)));
        }
        authors.sort_unstable();
        // In reverse order: once a successor's journal exists, its predecessor is dead, so the
        // predecessor's journal is complete when it is read afterwards.
        for author in authors.iter().rev() {
            let reader = match self.open.entry(*author) {
                std::collections::btree_map::Entry::Occupied(open) => open.into_mut(),
                std::collections::btree_map::Entry::Vacant(vacant) => {
                    vacant.insert(JournalReader::open(&author.path(&self.folder))?)
                }
            };
            reader.read().with_context(|| format!("cannot read the journal of {author:?}"))?;
        }
        Ok(authors)
    }

    /// Closes journals whose successor existed before their last read, and removes them unless
    /// [`Self::keep`] was called.
    fn remove_finished(&mut self) {
        let authors: Vec<Author> = self.open.keys().copied().collect();
        for pair in authors.windows(2) {
            let has_successor = match (pair[0], pair[1]) {
                (Author::Worker(one, _), Author::Worker(other, _)) => one == other,
                (Author::Learner(_), Author::Learner(_)) => true,
                _ => false,
            };
            if has_successor {
                self.open.remove(&pair[0]);
                if self.keep {
                    self.finished.insert(pair[0]);
                } else {
                    // On failure, the file stays until the folder is removed.
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

    fn read_new(journals: &mut Journals) -> (Vec<(Author, Entry)>, Violations) {
        let (mut found, mut violations) = (Vec::new(), Violations::default());
        let each = |author, record: &Record| found.push((author, record.entry));
        journals.for_each_new(&mut violations, each).unwrap();
        (found, violations)
    }

    #[test]
    fn records_are_passed_once_workers_first_and_finished_journals_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (Author::Worker(0, 9), Author::Worker(0, 10));
        let learner = journal(folder.path(), Author::Learner(0));
        let worker = journal(folder.path(), first);
        let mut journals = Journals::new(folder.path().to_owned());
        learner.note(Entry::Serving);
        worker.note(acknowledged(1));
        let expected = [(first, acknowledged(1)), (Author::Learner(0), Entry::Serving)];
        assert_eq!(read_new(&mut journals).0, expected);
        assert_eq!(read_new(&mut journals).0, []);
        worker.note(acknowledged(2));
        journal(folder.path(), second).note(acknowledged(3));
        assert_eq!(
            read_new(&mut journals).0,
            [(first, acknowledged(2)), (second, acknowledged(3))]
        );
        assert!(!first.path(folder.path()).exists() && second.path(folder.path()).exists());
    }

    #[test]
    fn incomplete_records_are_completed_later_and_damaged_ones_reported() {
        let folder = tempfile::tempdir().unwrap();
        let author = Author::Learner(0);
        let record = Record { entry: Entry::Serving, time_us: 1 }.encode();
        let mut file = File::create(author.path(folder.path())).unwrap();
        let mut journals = Journals::new(folder.path().to_owned());
        file.write_all(&record[..50]).unwrap();
        let (found, violations) = read_new(&mut journals);
        assert!(found.is_empty() && violations.is_empty());
        file.write_all(&record[50..]).unwrap();
        assert_eq!(read_new(&mut journals).0, [(author, Entry::Serving)]);
        let mut damaged = record;
        damaged[0] ^= 1;
        file.write_all(&damaged).unwrap();
        let (found, violations) = read_new(&mut journals);
        assert_eq!((found.len(), violations.count()), (0, 1));
    }
}
