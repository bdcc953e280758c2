//! Lists the files that `dmprl record` has written for a run.

use std::fs;
use std::io::ErrorKind;
use std::path::PathBuf;

use anyhow::Context;
use dmprl_run::RunDirectory;
use serde::Serialize;

/// File types that a browser can show.
const EXTENSIONS: [&str; 3] = ["mp4", "gif", "png"];
/// Maximum number of files in the list.
const VIDEOS_MAX: usize = 200;

/// A file in `videos/`.
#[derive(Debug, Serialize)]
pub struct Video {
    pub name: String,
    pub bytes: u64,
}

/// Folder of the videos.
pub fn folder(run: &RunDirectory) -> PathBuf {
    run.path().join("videos")
}

/// Lists regular files that a browser can show, by name; links are skipped.
///
/// # Errors
/// The folder cannot be read.
pub fn list(run: &RunDirectory) -> anyhow::Result<Vec<Video>> {
    let folder = folder(run);
    let entries = match fs::read_dir(&folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => {
            return Err(error).with_context(|| format!("cannot read {}", folder.display()));
        }
    };
    let mut videos: Vec<Video> = entries
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))
        .filter_map(|entry| {
            let bytes = entry.metadata().ok()?.len();
            Some(Video { name: entry.file_name().into_string().ok()?, bytes })
        })
        .filter(|video| {
            let extension = video.name.rsplit_once('.').map(|(_, extension)| extension);
            extension.is_some_and(|extension| EXTENSIONS.contains(&extension))
        })
        .collect();
    videos.sort_by(|a, b| a.name.cmp(&b.name));
    videos.truncate(VIDEOS_MAX);
    Ok(videos)
}
