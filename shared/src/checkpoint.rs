//! Names of checkpoints, for the learner, which writes them, and the supervisor, which lists them.

use std::fs;
use std::io;
use std::path::Path;

/// Returns the names of the complete checkpoints in a folder, oldest first. Entries of the folder
/// whose name is not a number are ignored.
///
/// # Errors
/// If the folder cannot be read.
pub fn names(folder: &Path) -> io::Result<Vec<String>> {
    let mut numbered = Vec::new();
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        if let Ok(number) = name.parse::<u64>() {
            numbered.push((number, name));
        }
    }
    numbered.sort_unstable();
    Ok(numbered.into_iter().map(|(_, name)| name).collect())
}
