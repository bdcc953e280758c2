//! Reads the lines that were appended to a file since the last read.

use std::fs::File;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// Maximum number of bytes per read; the next read returns the rest.
const BYTES_MAX: u64 = 8 << 20;
/// Length of the remembered end of the last line, by which a replaced file is recognised.
const MARK_LEN: usize = 128;

/// A file of lines and the position up to which it has been read.
#[derive(Debug)]
pub struct Tail {
    path: PathBuf,
    offset: u64,
    mark: Vec<u8>,
}

/// Result of a read.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Look {
    /// True if the file was cut by a resume or replaced; `lines` then starts at its beginning.
    pub begun_again: bool,
    /// Complete lines with their line ends.
    pub lines: Vec<u8>,
    /// True if there is more to read.
    pub more: bool,
}

impl Tail {
    /// Creates the tail of a file, which need not exist yet.
    #[must_use]
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), offset: 0, mark: Vec::new() }
    }

    /// Reads the next lines; an incomplete line is left for the next read.
    ///
    /// # Errors
    /// The file cannot be read, or a line is too long.
    pub fn look(&mut self) -> anyhow::Result<Look> {
        let cannot = || format!("cannot read {}", self.path.display());
        let mut file = match File::open(&self.path) {
            Ok(file) => Some(file),
            Err(error) if error.kind() == ErrorKind::NotFound => None,
            Err(error) => return Err(error).with_context(cannot),
        };
        let mut look = Look::default();
        let known = match &mut file {
            Some(file) => self.knows(file).with_context(cannot)?,
            None => self.offset == 0,
        };
        if !known {
            (self.offset, look.begun_again) = (0, true);
            self.mark.clear();
        }
        let Some(mut file) = file else { return Ok(look) };
        file.seek(SeekFrom::Start(self.offset)).with_context(cannot)?;
        file.take(BYTES_MAX).read_to_end(&mut look.lines).with_context(cannot)?;
        let full = look.lines.len() as u64 == BYTES_MAX;
        let whole = look.lines.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        if full && whole == 0 {
            bail!(
                "{}: a line at byte {} is longer than {BYTES_MAX} bytes",
                self.path.display(),
                self.offset
            );
        }
        look.lines.truncate(whole);
        look.more = full;
        self.offset += whole as u64;
        self.mark.extend_from_slice(&look.lines[whole.saturating_sub(MARK_LEN)..]);
        self.mark.drain(..self.mark.len().saturating_sub(MARK_LEN));
        Ok(look)
    }

    /// Returns true if the last line read is still at its position.
    fn knows(&self, file: &mut File) -> std::io::Result<bool> {
        if file.metadata()?.len() < self.offset {
            return Ok(false);
        }
        let mut found = vec![0; self.mark.len()];
        file.seek(SeekFrom::Start(self.offset - self.mark.len() as u64))?;
        file.read_exact(&mut found)?;
        Ok(found == self.mark)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn lines(look: &Look) -> &str {
        std::str::from_utf8(&look.lines).unwrap()
    }

    #[test]
    fn only_new_and_complete_lines_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows");
        let mut tail = Tail::new(&path);
        assert_eq!(tail.look().unwrap(), Look::default());
        fs::write(&path, "one\ntw").unwrap();
        assert_eq!(lines(&tail.look().unwrap()), "one\n");
        assert_eq!(lines(&tail.look().unwrap()), "");
        fs::write(&path, "one\ntwo\nthree\n").unwrap();
        let look = tail.look().unwrap();
        assert_eq!((lines(&look), look.begun_again), ("two\nthree\n", false));
    }

    /// A resume removes the rows after its checkpoint, and the run soon has as many as before.
    #[test]
    fn a_truncated_file_is_read_from_the_start_even_if_it_has_grown_longer_since() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows");
        let mut tail = Tail::new(&path);
        fs::write(&path, "one\ntwo\n").unwrap();
        tail.look().unwrap();
        fs::write(&path, "one\nzwo\nthree\n").unwrap();
        let look = tail.look().unwrap();
        assert_eq!((lines(&look), look.begun_again), ("one\nzwo\nthree\n", true));
        fs::write(&path, "one\n").unwrap();
        assert!(tail.look().unwrap().begun_again);
        fs::remove_file(&path).unwrap();
        assert!(tail.look().unwrap().begun_again);
    }
}
