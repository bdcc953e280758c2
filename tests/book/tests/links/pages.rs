//! Reads a built page: its links, the files that a browser loads for it, its anchors.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Pages without content of their own: the one for missing pages, which has no fixed address, and
/// the one with all pages for a printer, whose links are those of the pages.
const NOT_LOOKED_AT: [&str; 2] = ["404.html", "print.html"];

/// A built page.
pub struct Page {
    pub path: PathBuf,
    pub text: String,
    /// Targets of `<a href>` and `<img src>`.
    pub links: Vec<String>,
    /// Targets of `<img src>`, `<script src>` and `<link href>`.
    pub fetched: Vec<String>,
    /// Value of every `id`.
    pub anchors: BTreeSet<String>,
}

/// Reads the pages below a folder.
pub fn built_pages(folder: &Path) -> Vec<Page> {
    let mut pages = Vec::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        let path = entry.path();
        let name = entry.file_name().into_string().unwrap();
        if path.is_dir() {
            pages.extend(built_pages(&path));
        } else if name.ends_with(".html") && !NOT_LOOKED_AT.contains(&name.as_str()) {
            pages.push(read(path.canonicalize().unwrap()));
        }
    }
    pages
}

fn read(path: PathBuf) -> Page {
    let text = fs::read_to_string(&path).unwrap();
    let mut links = Vec::new();
    let mut fetched = Vec::new();
    let mut anchors = BTreeSet::new();
    for tag in tags(&text) {
        let name = tag.split([' ', '\n', '>']).next().unwrap();
        match (name, attribute(tag, "href"), attribute(tag, "src")) {
            ("a", Some(link), _) => links.push(link),
            ("img", _, Some(link)) => {
                links.push(link.clone());
                fetched.push(link);
            }
            ("link", Some(link), _) | ("script", _, Some(link)) => fetched.push(link),
            _ => {}
        }
        anchors.extend(attribute(tag, "id"));
    }
    Page { path, text, links, fetched, anchors }
}

/// Returns the tags of a page. Code in a page is escaped, and scripts contain no tags with the
/// names that are searched for.
fn tags(text: &str) -> impl Iterator<Item = &str> {
    text.split('<').skip(1).filter_map(|rest| rest.split('>').next())
}

fn attribute(tag: &str, name: &str) -> Option<String> {
    let rest = tag.split_once(&format!(" {name}=\""))?.1;
    let value = rest.split('"').next()?;
    Some(value.replace("&amp;", "&").replace("&#x27;", "'").replace("&quot;", "\""))
}
