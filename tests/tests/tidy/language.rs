//! Rules on language and signatures: plain English, and named structs instead of tuples.

#[cfg(feature = "python")]
use dmprl_actors::python_env::LINKED_PYTHON;

use super::{none, sources};

/// Maximum number of matches that `tests/prose.py` counts. There were 2,172 before the texts were
/// rewritten.
#[cfg(feature = "python")]
const PROSE_MATCHES_MAX: u64 = 80;

#[cfg(feature = "python")]
#[test]
fn the_text_is_plain_english() {
    let output = std::process::Command::new(LINKED_PYTHON.executable)
        .arg(dmprl_tests::project_root().join("tests/prose.py"))
        .arg("--json")
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "tests/prose.py failed:\n{errors}");
    let counts: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let total = counts["total"].as_u64().unwrap();
    assert!(
        total <= PROSE_MATCHES_MAX,
        "{total} phrases are hard to read, at most {PROSE_MATCHES_MAX}: {}\nlist them: \
         python3 tests/prose.py --list",
        counts["patterns"]
    );
}

#[test]
fn parameters_are_not_anonymous_tuples() {
    let mut places = Vec::new();
    // This file has examples.
    let others = sources(&["rs"]).into_iter().filter(|it| !it.path.ends_with("tidy/language.rs"));
    for source in others {
        for (at, _) in source.text.match_indices("fn ") {
            let begins_word =
                !source.text[..at].ends_with(|it: char| it.is_alphanumeric() || it == '_');
            let Some(parameters) = begins_word.then(|| parameters(&source.text[at..])).flatten()
            else {
                continue;
            };
            if takes_tuple(parameters) {
                let line = source.text[..at].lines().count();
                places.push(format!("{}:{line}: ({parameters})", source.path));
            }
        }
    }
    none(&places, "parameters that belong together are a struct with named fields");
}

/// Returns the parameter list of a function whose text begins with `fn `, without the parentheses.
fn parameters(function: &str) -> Option<&str> {
    let name_end = function[3..].find(|it: char| !it.is_alphanumeric() && it != '_')? + 3;
    let open = match function.as_bytes().get(name_end)? {
        b'(' => name_end,
        b'<' => name_end + function[name_end..].find(">(")? + 1,
        _ => return None,
    };
    let mut depth = 0_usize;
    for (at, letter) in function[open..].char_indices() {
        match letter {
            '(' => depth += 1,
            ')' if depth == 1 => return Some(&function[open + 1..open + at]),
            ')' => depth -= 1,
            _ => {}
        }
    }
    None
}

/// Returns true if the type of a parameter is a tuple or a reference to one.
fn takes_tuple(parameters: &str) -> bool {
    let types = top_level(parameters, ',').filter_map(|one| top_level(one, ':').nth(1));
    types.map(|it| it.trim().trim_start_matches('&').trim_start_matches("mut ")).any(|it| {
        it.starts_with('(')
            && !["()", "(dyn ", "(impl "].iter().any(|exception| it.starts_with(exception))
    })
}

/// Splits text at a letter, except within brackets.
fn top_level(text: &str, separator: char) -> impl Iterator<Item = &str> {
    let mut depth = 0_i32;
    let mut previous = ' ';
    text.split(move |letter| {
        match letter {
            '(' | '<' | '[' => depth += 1,
            '>' if previous == '-' => {}
            ')' | '>' | ']' => depth -= 1,
            _ => {}
        }
        previous = letter;
        depth == 0 && letter == separator
    })
}

#[test]
fn tuples_among_parameters_are_found() {
    let tuple = |text: &str| takes_tuple(parameters(text).unwrap());
    assert!(tuple("fn a((x, y): (u32, u32)) {"));
    assert!(tuple("fn a<T: Copy>(&self, run: &mut (T, u32), n: u8)"));
    assert!(!tuple("fn a(work: &(dyn Fn((u8, u8)) + Sync)) {"));
    assert!(!tuple("fn a(pairs: &[(u32, u32)], unit: ()) -> (u8, u8) {"));
}
