//! The book builds, its links have targets, and its pages load nothing from a network.
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod pages;

use std::fs;
use std::path::{Path, PathBuf};

use pages::{Page, built_pages};

#[test]
fn every_link_has_a_target_and_no_page_needs_a_network() {
    let pages = built_pages(&dmprl_book::build().unwrap());
    assert!(pages.len() > 15, "only {} pages were built", pages.len());
    let mut wrong = Vec::new();
    for page in &pages {
        if page.text.contains("{{#") {
            wrong.push(format!("{}: an include was not found", page.path.display()));
        }
        if let Some(number) = unlinked(&page.text) {
            wrong.push(format!("{}: [{number}] has no link", page.path.display()));
        }
        let remote = page.fetched.iter().filter(|link| link.contains("//"));
        wrong.extend(remote.map(|link| format!("{} fetches {link}", page.path.display())));
        wrong.extend(page.links.iter().filter_map(|link| {
            let reason = fault(page, link, &pages)?;
            Some(format!("{}: {link}: {reason}", page.path.display()))
        }));
    }
    assert!(wrong.is_empty(), "links in the book:\n  {}\n", wrong.join("\n  "));
}

fn docs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs")
}

/// Returns what is wrong with a link, if anything.
fn fault(page: &Page, link: &str, pages: &[Page]) -> Option<String> {
    if link.starts_with("data:") {
        return None;
    }
    if let Some((scheme, rest)) = link.split_once(':') {
        let host = rest.strip_prefix("//").and_then(|rest| rest.split('/').next());
        let fine = scheme == "https" && host.is_some_and(|host| host.contains('.'));
        return (!fine).then(|| "expected https://HOST/…".into());
    }
    let (path, anchor) = link.split_once('#').unwrap_or((link, ""));
    let folder = page.path.parent().unwrap();
    let target = if path.is_empty() { page.path.clone() } else { folder.join(path) };
    let Ok(target) = target.canonicalize() else { return Some("the file does not exist".into()) };
    if anchor.is_empty() {
        return None;
    }
    let target = pages.iter().find(|page| page.path == target)?;
    let there = target.anchors.contains(anchor);
    (!there).then(|| format!("{} has no #{anchor}", target.path.display()))
}

/// Returns a decision's number in brackets that did not become a link, such as `[0130]`.
fn unlinked(text: &str) -> Option<&str> {
    let in_brackets = text.split('[').skip(1).filter_map(|rest| rest.split_once(']'));
    in_brackets
        .map(|(inside, _)| inside)
        .find(|inside| inside.len() == 4 && inside.bytes().all(|byte| byte.is_ascii_digit()))
}

#[test]
fn every_page_in_docs_is_in_the_table_of_contents() {
    let docs = docs();
    let contents = fs::read_to_string(docs.join("SUMMARY.md")).unwrap();
    for folder in ["", "decisions/", "internals/"] {
        for entry in fs::read_dir(docs.join(folder)).unwrap().flatten() {
            let page = format!("{folder}{}", entry.file_name().into_string().unwrap());
            let is_page = Path::new(&page).extension().is_some_and(|it| it == "md");
            let listed = contents.contains(&format!("]({page})"));
            assert!(!is_page || listed || page == "SUMMARY.md", "docs/SUMMARY.md lacks {page}");
        }
    }
}
