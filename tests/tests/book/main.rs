//! The book in `docs/`: it builds, every link in it leads somewhere, it reads without a network,
//! and its list of configuration keys is what the types say.
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod equations;
mod keys;
mod pages;

use std::fs;
use std::path::Path;

use dmprl_tests::project_root;
use equations::{Equations, with_mathml};
use mdbook_driver::MDBook;
use pages::{Page, built_pages};

const KEYS: &str = "docs/configuration-keys.md";
/// Set to write the list of keys anew instead of comparing it.
const WRITE: &str = "WRITE_CONFIGURATION_KEYS";

#[test]
fn the_list_of_configuration_keys_is_what_the_types_say() {
    let path = project_root().join(KEYS);
    let made = keys::page();
    if std::env::var_os(WRITE).is_some() {
        fs::write(&path, made).unwrap();
        return;
    }
    let written = fs::read_to_string(&path).unwrap_or_default();
    let same = written.lines().zip(made.lines()).take_while(|(a, b)| a == b).count();
    assert!(
        written == made,
        "{KEYS} differs from the types in shared/src/config from line {} on:\n  it says  {:?}\n  \
         the types {:?}\nwrite it anew: {WRITE}=1 cargo test --release --test book",
        same + 1,
        written.lines().nth(same),
        made.lines().nth(same),
    );
}

#[test]
fn the_book_builds_reads_without_a_network_and_every_link_in_it_leads_somewhere() {
    let mut book = MDBook::load(project_root().join("docs")).unwrap();
    book.with_preprocessor(Equations);
    let mathjax = book.config.html_config().is_some_and(|html| html.mathjax_support);
    assert!(!mathjax, "MathJax comes from the network, which the book must not need");
    book.build().unwrap();
    let pages = built_pages(&book.build_dir_for("html"));
    assert!(pages.len() > 15, "only {} pages were built", pages.len());
    let mut wrong = Vec::new();
    for page in &pages {
        if page.text.contains("{{#") {
            wrong.push(format!("{}: an include was not found", page.path.display()));
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

#[test]
fn an_invalid_equation_is_an_error_that_shows_it() {
    let page = with_mathml("a\n```math\n\\frac{1}{2}\n```\nb\n").unwrap();
    assert!(page.contains("<mfrac>") && page.ends_with("b\n"), "{page}");
    let error = with_mathml("```math\n\\frac{1\n```\n").unwrap_err().to_string();
    assert!(error.contains("\\\\frac{1"), "{error}");
    assert!(with_mathml("```math\nx\n").is_err());
}

/// What is wrong with a link, if anything is.
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
    let Ok(target) = target.canonicalize() else { return Some("there is no such file".into()) };
    if anchor.is_empty() {
        return None;
    }
    let target = pages.iter().find(|page| page.path == target)?;
    let there = target.anchors.contains(anchor);
    (!there).then(|| format!("{} has no #{anchor}", target.path.display()))
}

#[test]
fn every_page_in_docs_is_in_the_table_of_contents() {
    let docs = project_root().join("docs");
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
