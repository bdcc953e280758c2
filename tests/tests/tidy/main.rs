//! Rules of the project that can be checked by reading the repository, within a second;
//! ARCHITECTURE.md lists them with their reasons.
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

mod configuration_keys;
mod language;
mod structure;

use std::fs;
use std::path::Path;

use dmprl_tests::project_root;

const FILE_LINES_MAX: usize = 500;
const FUNCTION_LINES_MAX: usize = 70;
const COLUMNS_MAX: usize = 100;
const STAGES: u32 = 8;
/// Folders that are built, downloaded or written by runs.
const FOREIGN_FOLDERS: [&str; 6] =
    ["target", "runs", "__pycache__", ".git", ".venv", ".venv-peers"];
/// Start of the names of environments that were replaced.
const OLD_ENVIRONMENT: &str = ".venv.old-";
const MEMBERS: [&str; 18] = [
    "actors",
    "deploy/analysis",
    "deploy/bench",
    "deploy/bridge",
    "deploy/chaos",
    "deploy/cli",
    "deploy/control",
    "deploy/dashboard",
    "deploy/extension",
    "deploy/run",
    "deploy/supervisor",
    "deploy/sweep",
    "learner",
    "shared",
    "shared/runtime",
    "tests",
    "tests/book",
    "tests/manifests",
];

/// A file of the repository.
struct Source {
    /// Relative to the project's directory.
    path: String,
    text: String,
}

impl Source {
    fn has_extension(&self, extensions: &[&str]) -> bool {
        let extension = Path::new(&self.path).extension().and_then(|it| it.to_str());
        extension.is_some_and(|extension| extensions.contains(&extension))
    }

    fn is_within(&self, folder: &str) -> bool {
        self.path.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/'))
    }

    /// Returns true for code that only tests run: a file of its own, a folder `tests`, this member
    /// crate.
    fn is_test(&self) -> bool {
        let name = Path::new(&self.path).file_stem().and_then(|it| it.to_str()).unwrap_or("");
        self.path.starts_with("tests/")
            || self.path.contains("/tests/")
            || name == "tests"
            || name.ends_with("_tests")
            || name == "test_support"
    }

    /// Returns the lines of code, numbered from 1, without comments and without the test module at
    /// the end of a file. `//` inside a string also ends a line, which hides no name that these
    /// rules search for.
    fn code(&self) -> impl Iterator<Item = (usize, &str)> {
        let lines = self.text.lines().enumerate();
        lines
            .take_while(|(_, line)| *line != "#[cfg(test)]")
            .map(|(index, line)| (index + 1, line.split("//").next().unwrap_or("")))
    }
}

fn sources(extensions: &[&str]) -> Vec<Source> {
    let mut found = Vec::new();
    collect(project_root(), &mut found);
    found.retain(|source| source.has_extension(extensions));
    assert!(!found.is_empty(), "no file ends in {extensions:?}: is this the project's directory?");
    found
}

fn collect(folder: &Path, found: &mut Vec<Source>) {
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        let kind = entry.file_type().unwrap();
        if kind.is_dir() && !is_foreign(&name) {
            collect(&entry.path(), found);
        } else if kind.is_file() {
            let path = entry.path();
            let path = path.strip_prefix(project_root()).unwrap().to_str().unwrap().to_owned();
            // Pictures and other binary files have no lines.
            if let Ok(text) = fs::read_to_string(entry.path()) {
                found.push(Source { path, text });
            }
        }
    }
}

fn is_foreign(folder: &str) -> bool {
    FOREIGN_FOLDERS.contains(&folder) || folder.starts_with(OLD_ENVIRONMENT)
}

fn read(path: &str) -> String {
    fs::read_to_string(project_root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// Returns true if `text` contains `word` with no letter, digit or underscore on either side.
fn names(text: &str, word: &str) -> bool {
    let part_of_word = |letter: char| letter.is_alphanumeric() || letter == '_';
    text.match_indices(word).any(|(at, _)| {
        !text[..at].ends_with(part_of_word) && !text[at + word.len()..].starts_with(part_of_word)
    })
}

/// Fails with one line for each violation and the rule's reason.
fn none(violations: &[String], rule: &str) {
    assert!(violations.is_empty(), "{rule}\n  {}\n", violations.join("\n  "));
}

/// Returns every place outside `allowed` where Rust code or a manifest names `word`.
fn named_outside(word: &str, allowed: impl Fn(&Source) -> bool) -> Vec<String> {
    let mut places = Vec::new();
    for source in sources(&["rs"]).iter().filter(|source| !source.is_test() && !allowed(source)) {
        let lines = source.code().filter(|(_, line)| names(line, word));
        places.extend(lines.map(|(number, _)| format!("{}:{number} names {word}", source.path)));
    }
    places
}

/// Returns the members whose manifest has a dependency that begins with `prefix`.
fn dependents(prefix: &str) -> Vec<&'static str> {
    let asks = |member: &&str| {
        let manifest = read(&format!("{member}/Cargo.toml"));
        manifest.lines().any(|line| line.starts_with(prefix))
    };
    MEMBERS.into_iter().filter(asks).collect()
}

#[test]
fn actors_and_learner_do_not_know_each_other() {
    let mut places = named_outside("dmprl_learner", |source| !source.is_within("actors"));
    places.extend(named_outside("dmprl_actors", |source| !source.is_within("learner")));
    places.extend(named_outside("dmprl_learner", |source| !source.is_within("shared")));
    places.extend(named_outside("dmprl_actors", |source| !source.is_within("shared")));
    for member in dependents("dmprl-learner").into_iter().chain(dependents("dmprl-actors")) {
        if !member.starts_with("deploy/") && member != "tests" {
            places.push(format!("{member}/Cargo.toml depends on actors or learner"));
        }
    }
    none(&places, "actors and learner share only `shared`; deploy connects them");
}

#[test]
fn each_foreign_system_is_named_in_one_place() {
    let build_script = |source: &Source| source.path.ends_with("/build.rs");
    let mut places = named_outside("pyo3", |source| {
        source.is_within("actors/src/python_env")
            || source.is_within("deploy/extension")
            || build_script(source)
    });
    for word in ["iceoryx2", "iceoryx2_cal", "iceoryx2_bb_elementary_traits"] {
        places.extend(named_outside(word, |source| {
            source.is_within("shared/src/transport/shared_memory")
        }));
    }
    places.extend(named_outside("tokio", |source| source.is_within("deploy")));
    for word in ["Adam", "candle_core", "candle_nn"] {
        places.extend(named_outside(word, |source| source.is_within("learner")));
    }
    let owners = [
        ("pyo3", "actors"),
        ("iceoryx2", "shared"),
        ("tokio", "deploy/"),
        ("zenoh", "deploy/bridge"),
        ("candle", "learner"),
    ];
    for (prefix, owner) in owners {
        let is_owner = |member: &str| {
            member.starts_with(owner) || (prefix, member) == ("pyo3", "deploy/extension")
        };
        let others = dependents(prefix).into_iter().filter(|member| !is_owner(member));
        places.extend(others.map(|member| format!("{member}/Cargo.toml depends on {prefix}")));
    }
    none(
        &places,
        "pyo3, iceoryx2, tokio and optimisers are each named in one folder, so that each can be \
         replaced there",
    );
}

#[test]
fn shared_is_told_the_time_the_environment_and_randomness() {
    const OUTSIDE_WORLD: [&str; 10] = [
        "Instant",
        "SystemTime",
        "std::env",
        "env::var",
        "env::args",
        "thread_rng",
        "rand::rng",
        "OsRng",
        "SysRng",
        "getrandom",
    ];
    let mut places = Vec::new();
    for word in OUTSIDE_WORLD {
        places.extend(named_outside(word, |source| !source.is_within("shared")));
    }
    none(&places, "shared gets clock, environment variables and randomness as arguments");

    // Waiting reads no clock, but the data path must not wait. The one exception is the lock on the
    // parent of all runs' shared-memory directories: it is taken when a run starts and ends, other
    // starts hold it for microseconds, and the number of attempts is fixed.
    let sleeps = named_outside("sleep", |source| !source.is_within("shared"));
    let allowed = "shared/src/transport/shared_memory/domain.rs:";
    assert!(
        sleeps.len() <= 1 && sleeps.iter().all(|place| place.starts_with(allowed)),
        "shared waits for nothing but the lock in {allowed} {sleeps:?}"
    );
}

/// The wall clock may jump, also backwards. Waits, limits and measurements use the monotonic clock;
/// the wall clock only gives names and dates to files.
#[test]
fn the_clock_on_the_wall_is_read_for_names_and_dates_only() {
    const STAMPS: [&str; 5] = [
        "deploy/cli/src/cli/report.rs",
        "deploy/cli/src/cli/train.rs",
        "deploy/supervisor/src/launcher.rs",
        "deploy/run/src/manifest.rs",
        "deploy/run/src/timestamp.rs",
    ];
    let stamps = |source: &Source| STAMPS.contains(&source.path.as_str());
    let mut places = Vec::new();
    // Times of files are wall-clock times too.
    for word in ["SystemTime", "UNIX_EPOCH", "modified", "accessed", "CLOCK_REALTIME", "Realtime"] {
        places.extend(named_outside(word, stamps));
    }
    for source in sources(&["py"]).iter().filter(|source| !source.is_test()) {
        for word in ["time.time", "time.time_ns", "datetime"] {
            let lines = source.code().filter(|(_, line)| names(line, word));
            places.extend(lines.map(|(at, _)| format!("{}:{at} names {word}", source.path)));
        }
    }
    none(&places, "limits and waits use Instant, in Python time.monotonic or time.perf_counter");
    // The exceptions only write times, and compare none.
    for path in STAMPS {
        let text = read(path);
        let code = text.split("#[cfg(test)]").next().unwrap_or_default();
        for word in ["elapsed", "duration_since(SystemTime::now"] {
            assert!(!code.contains(word), "{path} measures by the clock on the wall: {word}");
        }
    }
}

#[test]
fn nothing_is_async_on_the_data_path() {
    let mut places = Vec::new();
    for word in ["async", "await"] {
        places.extend(named_outside(word, |source| source.is_within("deploy")));
    }
    none(&places, "rollout, transport and update are plain loops on plain threads");
}

#[test]
fn files_functions_and_lines_are_short() {
    let mut places = Vec::new();
    for source in sources(&["rs", "py", "toml"]) {
        let path = &source.path;
        let len = source.text.lines().count();
        if len > FILE_LINES_MAX {
            places.push(format!("{path}: {len} lines, at most {FILE_LINES_MAX}"));
        }
        for (index, line) in source.text.lines().enumerate() {
            let columns = line.chars().count();
            if columns > COLUMNS_MAX {
                let number = index + 1;
                places.push(format!("{path}:{number}: {columns} columns, at most {COLUMNS_MAX}"));
            }
        }
        for (number, len) in functions(&source) {
            if len > FUNCTION_LINES_MAX {
                let max = FUNCTION_LINES_MAX;
                places.push(format!("{path}:{number}: function of {len} lines, at most {max}"));
            }
        }
    }
    none(&places, "a file fits on a few screens, a function on one");
}

/// Returns line number and length of every function, with brace and attributes. Both languages are
/// formatted by a tool, so the indentation shows where a function ends.
fn functions(source: &Source) -> Vec<(usize, usize)> {
    let lines: Vec<&str> = source.text.lines().collect();
    let indent_of = |line: &str| line.len() - line.trim_start().len();
    let mut found = Vec::new();
    for (start, line) in lines.iter().enumerate() {
        let indent = indent_of(line);
        let below = lines[start + 1..].iter();
        let len = if source.has_extension(&["rs"]) && begins_rust_function(line.trim_start()) {
            let ends = |line: &str| {
                indent_of(line) == indent && (line.trim() == "}" || line.ends_with(';'))
            };
            let whole = line.ends_with('}') || line.ends_with(';');
            if whole { Some(1) } else { below.clone().position(|it| ends(it)).map(|at| at + 2) }
        } else if source.has_extension(&["py"]) && line.trim_start().starts_with("def ") {
            let outside = |line: &str| {
                let text = line.trim_start();
                !text.is_empty() && !text.starts_with(')') && indent_of(line) <= indent
            };
            let rest = below.clone().count();
            Some(below.clone().position(|it| outside(it)).unwrap_or(rest) + 1)
        } else {
            None
        };
        found.extend(len.map(|len| (start + 1, len)));
    }
    found
}

fn begins_rust_function(line: &str) -> bool {
    let words = line.split_whitespace();
    let is_qualifier = |word: &str| {
        ["const", "async", "unsafe", "extern", "\"C\""].contains(&word) || word.starts_with("pub")
    };
    words.into_iter().find(|word| !is_qualifier(word)) == Some("fn")
}

#[test]
fn nothing_is_left_undone() {
    // Split in two parts, because this file is searched as well.
    let marks = [
        concat!("todo", "!"),
        concat!("unimplemented", "!"),
        concat!("dbg", "!"),
        concat!("#[", "ignore"),
        concat!("FIX", "ME"),
        concat!("TO", "DO"),
        concat!("XX", "X"),
    ];
    let mut places = Vec::new();
    for source in sources(&["rs", "py", "toml", "md", "sh", "yml"]) {
        for (index, line) in source.text.lines().enumerate() {
            let left = marks.iter().filter(|mark| line.contains(*mark));
            places.extend(left.map(|mark| format!("{}:{}: {mark}", source.path, index + 1)));
        }
    }
    none(&places, "unfinished work is an issue, not a mark in the code; no test is ignored");
}

#[test]
fn no_path_of_one_machine_is_written_down() {
    let machine_paths = [concat!("/ro", "ot/"), concat!("/wo", "rk/"), concat!("/Us", "ers/")];
    let mut places = Vec::new();
    for source in sources(&["rs", "py", "toml", "md", "sh", "yml", "cff", "svg", "json"]) {
        for (index, line) in source.text.lines().enumerate() {
            let found = machine_paths.iter().filter(|path| line.contains(*path));
            places.extend(found.map(|path| format!("{}:{}: {path}", source.path, index + 1)));
        }
    }
    none(&places, "the repository works in any directory of any user");
}

#[test]
fn every_stage_of_the_data_flow_is_announced_where_it_lives() {
    let entries = [
        (1, "shared/src/config/mod.rs"),
        (2, "deploy/supervisor/src/lib.rs"),
        (3, "actors/src/rollout.rs"),
        (4, "shared/src/transport/mod.rs"),
        (5, "learner/src/replay/mod.rs"),
        (6, "learner/src/update/mod.rs"),
        (7, "shared/src/transport/mod.rs"),
        (8, "actors/src/evaluate.rs"),
    ];
    assert_eq!(entries.map(|(stage, _)| stage).to_vec(), (1..=STAGES).collect::<Vec<_>>());
    for (stage, path) in entries {
        let text = read(path);
        let first = text.lines().next().unwrap_or_default();
        let stages: Vec<u32> = first
            .strip_prefix("//! Stage")
            .and_then(|rest| rest.split_once(&format!(" of {STAGES}")))
            .map(|(stages, _)| stages.split(' ').filter_map(|word| word.parse().ok()).collect())
            .unwrap_or_default();
        assert!(
            stages.contains(&stage),
            "{path} must begin with `//! Stage {stage} of {STAGES}: …`, so that one search for \
             `Stage` lists the data flow; it begins with `{first}`"
        );
    }
}

#[test]
fn a_files_name_says_what_is_in_it() {
    const NAMES_OF_NOTHING: [&str; 9] =
        ["utils", "util", "common", "manager", "helper", "helpers", "base", "misc", "core"];
    let mut places = Vec::new();
    for source in sources(&["rs", "py"]) {
        let parts = Path::new(&source.path).components().filter_map(|it| it.as_os_str().to_str());
        let stems = parts.map(|part| part.split('.').next().unwrap_or(part));
        let empty = stems.filter(|stem| NAMES_OF_NOTHING.contains(stem));
        places.extend(empty.map(|stem| format!("{}: {stem}", source.path)));
    }
    none(&places, "a file's name describes its content");
}

#[test]
fn the_workspace_decides_versions_and_lints_once() {
    let mut places = Vec::new();
    for member in MEMBERS {
        let manifest = read(&format!("{member}/Cargo.toml"));
        if !manifest.contains("[lints]\nworkspace = true") {
            places.push(format!("{member}/Cargo.toml: `[lints] workspace = true` is missing"));
        }
        let versions = manifest.lines().filter(|line| line.contains("version = \""));
        places.extend(versions.map(|line| format!("{member}/Cargo.toml: {line}")));
    }
    none(&places, "versions and lints are in the workspace's Cargo.toml");
}

/// No test runs after the list of skipped tests.
#[test]
fn the_list_of_skipped_tests_comes_last() {
    const LAST: &str = "what_was_skipped";
    let mut places = Vec::new();
    for member in MEMBERS {
        let manifest = read(&format!("{member}/Cargo.toml"));
        // Not part of `cargo test`.
        if ["tests/book", "tests/manifests"].contains(&member) {
            continue;
        }
        if !manifest.contains("[lib]\ndoctest = false") {
            places.push(format!("{member}/Cargo.toml: doc-tests would run after the list"));
        }
        let name = manifest.split('"').nth(1).unwrap();
        if name > "dmprl-tests" {
            places.push(format!("{member}: cargo runs the tests of {name} after dmprl-tests"));
        }
    }
    for entry in fs::read_dir(project_root().join("tests/tests")).unwrap().flatten() {
        let name = entry.path().file_stem().unwrap().to_string_lossy().into_owned();
        if name.as_str() > LAST {
            places.push(format!("tests/tests/{name} runs after {LAST}"));
        }
    }
    none(&places, "cargo runs packages and their tests in the order of their names");
}

#[test]
fn the_lock_file_is_part_of_the_repository() {
    assert!(project_root().join("Cargo.lock").is_file(), "Cargo.lock is missing: commit it");
    let ignored = read(".gitignore").lines().any(|line| line.trim_matches('/') == "Cargo.lock");
    assert!(!ignored, ".gitignore must not name Cargo.lock: everyone builds the same versions");
}

#[test]
fn function_lengths_are_counted_in_both_languages() {
    let rust =
        "pub fn a() {\n    b();\n}\n\nfn c();\n\npub(crate) async fn d(\n    e: u8,\n) {\n}\n";
    let source = Source { path: "a.rs".into(), text: rust.into() };
    assert_eq!(functions(&source), [(1, 3), (5, 1), (7, 4)]);
    let python =
        "class A:\n    def a(\n        self\n    ):\n        b()\n\n    def c(self): ...\n";
    let source = Source { path: "a.py".into(), text: python.into() };
    assert_eq!(functions(&source), [(2, 5), (7, 1)]);
}
