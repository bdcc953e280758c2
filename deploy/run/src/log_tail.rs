//! Reads the end of a process's log, for error messages.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Maximum number of lines.
const LOG_LINES: usize = 15;
/// Maximum number of bytes from the end of the log in which to look for them.
const LOG_TAIL_BYTES: u64 = 64 << 10;

/// Returns the last lines of a log, indented; empty if it cannot be read.
#[must_use]
pub fn last_lines(path: &Path) -> String {
    let read = || -> std::io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let len = file.metadata()?.len();
        file.seek(SeekFrom::Start(len.saturating_sub(LOG_TAIL_BYTES)))?;
        let mut tail = Vec::new();
        file.take(LOG_TAIL_BYTES).read_to_end(&mut tail)?;
        Ok(tail)
    };
    let tail = read().unwrap_or_default();
    let text = String::from_utf8_lossy(&tail);
    let lines: Vec<&str> = text.lines().collect();
    let last = lines[lines.len().saturating_sub(LOG_LINES)..].iter().map(|line| {
        // An environment may have printed control characters, which could change the terminal.
        let plain = line.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
        format!("    {}", plain.collect::<String>())
    });
    last.collect::<Vec<_>>().join("\n")
}
