//! Builds the book from the pages in `docs/`, as `target/book/`.
//!
//! `cargo run --release --package dmprl-book` builds it; the tests of this package check its links.
//! A package of its own, so that the program and its tests compile without mdBook.

mod equations;

use std::path::{Path, PathBuf};

use anyhow::ensure;
use mdbook_driver::MDBook;

/// Builds the book and returns the folder with its pages.
///
/// # Errors
/// A page is missing, an equation is invalid, or a file cannot be written.
pub fn build() -> anyhow::Result<PathBuf> {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs").canonicalize()?;
    let mut book = MDBook::load(docs)?;
    let mathjax = book.config.html_config().is_some_and(|html| html.mathjax_support);
    ensure!(!mathjax, "docs/book.toml asks for MathJax, which needs a network; expected MathML");
    book.with_preprocessor(equations::Equations);
    book.build()?;
    Ok(book.build_dir_for("html"))
}
