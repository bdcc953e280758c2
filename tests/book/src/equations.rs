//! A preprocessor of the book that turns TeX equations into MathML, which browsers render without
//! a script or a network. Called by lib.rs.

use anyhow::anyhow;
use math_core::{LatexToMathML, MathCoreConfig, MathDisplay};
use mdbook_driver::book::{Book, BookItem};
use mdbook_preprocessor::{Preprocessor, PreprocessorContext};

/// First line of an equation. GitHub renders such blocks too.
const OPENING: &str = "```math";
const CLOSING: &str = "```";

/// Replaces each fenced block of the language `math` by a block of MathML.
pub(crate) struct Equations;

impl Preprocessor for Equations {
    fn name(&self) -> &'static str {
        "equations"
    }

    /// # Errors
    /// An equation is not valid TeX or has no end; the error names its page and shows it.
    fn run(&self, _context: &PreprocessorContext, mut book: Book) -> anyhow::Result<Book> {
        let mut result = Ok(());
        book.for_each_mut(|item| {
            if let BookItem::Chapter(chapter) = item
                && result.is_ok()
            {
                match with_mathml(&chapter.content) {
                    Ok(content) => chapter.content = content,
                    Err(error) => result = Err(error.context(chapter.name.clone())),
                }
            }
        });
        result.map(|()| book)
    }
}

/// Returns a page with its equations as MathML.
///
/// # Errors
/// An equation is not valid TeX or has no end.
fn with_mathml(page: &str) -> anyhow::Result<String> {
    let converter = LatexToMathML::new(MathCoreConfig::default())
        .map_err(|error| anyhow!("math-core refuses its own default: {error:?}"))?;
    let mut converted = String::with_capacity(page.len());
    let mut lines = page.lines();
    while let Some(line) = lines.next() {
        if line.trim_end() != OPENING {
            converted.push_str(line);
            converted.push('\n');
            continue;
        }
        let mut tex = Vec::new();
        loop {
            match lines.next() {
                Some(line) if line.trim_end() == CLOSING => break,
                Some(line) => tex.push(line),
                None => return Err(anyhow!("an equation has no end: {tex:?}")),
            }
        }
        let tex = tex.join(" ");
        let mathml = converter
            .convert_with_local_counter(&tex, MathDisplay::Block)
            .map_err(|error| anyhow!("invalid equation {tex:?}: {error:?}"))?;
        converted.push_str(&format!("<div class=\"equation\">\n{mathml}\n</div>\n"));
    }
    Ok(converted)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_equation_is_an_error_that_shows_it() {
        let page = with_mathml("a\n```math\n\\frac{1}{2}\n```\nb\n").unwrap();
        assert!(page.contains("<mfrac>") && page.ends_with("b\n"), "{page}");
        let error = with_mathml("```math\n\\frac{1\n```\n").unwrap_err().to_string();
        assert!(error.contains("\\\\frac{1"), "{error}");
        assert!(with_mathml("```math\nx\n").is_err());
    }
}
