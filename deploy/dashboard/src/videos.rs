//! Lists the videos and pictures that `dmprl record` has made of a run.

use std::fs;
use std::io::ErrorKind;
use std::path::PathBuf;

use anyhow::Context;
use dmprl_run::RunDirectory;
use serde::Serialize;

/// File types that a browser can show.
const EXTENSIONS: [&str; 3] = ["mp4", "gif", "png"];
/// Maximum number of files listed.
const VIDEOS_MAX: usize = 200;

/// A file in the run's `videos` folder.
#[derive(Debug, Serialize)]
pub struct Video {
    pub name: String,
    pub bytes: u64,
}

/// Returns the path of a run's `videos` folder.
pub fn folder(run: &RunDirectory) -> PathBuf {
    run.path().join("videos")
}

/// Lists the files that a browser can show, sorted by name; links are skipped.
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
