//! Checks README, the book, ARCHITECTURE and the example configurations against the program.
//! `tests/tests/program/documents.rs` runs their code, and `tests/book` builds the
//! book and checks its links.
#![allow(clippy::unwrap_used)] // helpers of tests fail as tests do

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use dmprl_control::EvaluationRow;
use dmprl_learner::metrics::{DeliveryLine, MetricsLine, Rejected};
use dmprl_shared::config::{ExperimentConfig, Layers, Limits, task_defaults};

const EXAMPLES: &str = "docs/examples";
const LIMITS: Limits = Limits { cores: 2 };
/// Commands that call the program in the documents.
const CALLS: [&str; 3] = ["cargo run --release -- ", "target/release/dmprl ", "dmprl "];
/// Flags of other programs: cargo's, TensorBoard's, docker's, and those of Slurm's sbatch.
const FOREIGN: [&str; 18] = [
    "--bind",
    "--bench",
    "--package",
    "--features",
    "--release",
    "--check",
    "--logdir",
    "--shm-size",
    "--volumes",
    "--nodes",
    "--ntasks-per-node",
    "--cpus-per-task",
    "--mem",
    "--time",
    "--signal",
    "--requeue",
    "--open-mode",
    "--no-kill",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap()
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn help(arguments: &[&str]) -> String {
    let output =
        Command::new(env!("CARGO_BIN_EXE_dmprl")).args(arguments).arg("--help").output().unwrap();
    assert!(output.status.success(), "{arguments:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Lists the handwritten documents. Pages that `report` has written in `docs/results` are excluded.
fn documents() -> Vec<String> {
    let beside = ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "SECURITY.md", "tests/FAULTS.md"];
    let mut documents: Vec<String> = beside.map(str::to_owned).into();
    for folder in ["docs", "docs/decisions", "docs/internals"] {
        for entry in std::fs::read_dir(root().join(folder)).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            if name.ends_with(".md") {
                documents.push(format!("{folder}/{name}"));
            }
        }
    }
    assert!(documents.len() > 20, "only {documents:?}; has the book moved?");
    documents
}

/// Returns the long flags in a text.
fn flags(text: &str) -> BTreeSet<String> {
    let words = text.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '-');
    let long = words.filter(|word| word.starts_with("--") && word.len() > 2);
    long.map(str::to_owned).collect()
}

/// Returns code between single backticks, outside fenced blocks.
fn spans(text: &str) -> Vec<String> {
    let mut spans = Vec::new();
    let mut fenced = false;
    for line in text.lines() {
        if line.starts_with("```") {
            fenced = !fenced;
        } else if !fenced {
            spans.extend(line.split('`').skip(1).step_by(2).map(str::to_owned));
        }
    }
    spans
}

/// Returns the fenced blocks of a language, with or without attributes after its name.
fn blocks(text: &str, language: &str) -> Vec<String> {
    let fence = format!("```{language}");
    let starts = text.split(fence.as_str()).skip(1);
    let of_language = starts.filter(|rest| rest.starts_with(['\n', ',']));
    let code = of_language.filter_map(|rest| rest.split_once('\n'));
    code.map(|(_, code)| code.split("\n```").next().unwrap_or_default().to_owned()).collect()
}

/// Returns the section below a heading, up to the next heading of any level.
fn section<'a>(text: &'a str, heading: &str) -> &'a str {
    let below = text.split_once(&format!("\n{heading}\n")).map(|(_, below)| below);
    let below = below.unwrap_or_else(|| panic!("no heading `{heading}`"));
    below.split("\n#").next().unwrap_or(below)
}

/// Returns the code spans in the first cell of every row of a table.
fn first_cells(section: &str) -> BTreeSet<String> {
    cells(section, 1)
}

/// Code spans in a column of the tables, the first being 1.
fn cells(section: &str, column: usize) -> BTreeSet<String> {
    let rows = section.lines().filter(|line| line.starts_with("| "));
    rows.filter_map(|row| row.split('|').nth(column)).flat_map(spans).collect()
}

/// Merges the task's defaults and the file, as `train` does.
fn merged(text: &str, origin: &str) -> ExperimentConfig {
    let table: toml::Table = text.parse().unwrap_or_else(|error| panic!("{origin}: {error}"));
    let name = table.get("task").and_then(|task| task.get("name")).and_then(|name| name.as_str());
    let mut layers = Layers::new();
    if let Some(task) = name.and_then(task_defaults) {
        layers.add(task.name, task.table()).unwrap();
    }
    layers.add(origin, table).unwrap_or_else(|error| panic!("{error}"));
    layers.finish().unwrap().resolve(LIMITS).unwrap_or_else(|error| panic!("{origin}: {error}"))
}

#[test]
fn every_example_is_documented_and_every_example_configuration_is_valid() {
    let texts: Vec<_> = documents().iter().map(|document| read(document)).collect();
    let mut seen = 0;
    for entry in std::fs::read_dir(root().join(EXAMPLES)).unwrap() {
        let entry = entry.unwrap();
        if !entry.file_type().unwrap().is_file() {
            continue; // Python's bytecode cache
        }
        let name = entry.file_name().into_string().unwrap();
        let path = format!("examples/{name}");
        assert!(texts.iter().any(|text| text.contains(&path)), "no page names {name}");
        if name.ends_with(".toml") {
            let path = format!("{EXAMPLES}/{name}");
            let config = merged(&read(&path), &path);
            assert_ne!(config.task.name, "", "{path} names its task");
            for folder in &config.task.python_path {
                assert!(root().join(folder).is_dir(), "{path}: no folder {folder}");
            }
            seen += 1;
        }
    }
    assert!(seen >= 3, "only {seen} example configurations in {EXAMPLES}");
}

#[test]
fn the_table_of_commands_is_complete() {
    let readme = read("README.md");
    // The first column groups the commands.
    let commands = cells(section(&readme, "## Commands"), 2);
    let page = read("docs/commands.md");
    let roles = first_cells(section(&page, "## Roles"));
    let documented: BTreeSet<_> =
        commands.union(&roles).map(|cell| cell.split(' ').next().unwrap().to_owned()).collect();
    let help = help(&[]);
    let listed = |heading: &str| {
        let below = help.split_once(heading).unwrap_or_else(|| panic!("no {heading} in help")).1;
        let rows = below.lines().skip(1).take_while(|line| line.starts_with("  "));
        rows.map(|row| row.split_whitespace().next().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let mut existing: BTreeSet<_> = listed("Commands:").into_iter().collect();
    existing.extend(listed("ROLES"));
    existing.remove("help");
    assert_eq!(
        documented, existing,
        "README, `## Commands`, and docs/commands.md, `## Roles`, against `dmprl --help`"
    );
}

#[test]
fn the_table_of_train_flags_is_complete() {
    let page = read("docs/commands.md");
    let cells = first_cells(section(&page, "## Flags of `train`"));
    let documented: BTreeSet<_> = cells.iter().flat_map(|cell| flags(cell)).collect();
    let usage = help(&["train"]);
    let mut existing = flags(usage.split("PRECEDENCE").next().unwrap());
    existing.remove("--help");
    assert_eq!(
        documented, existing,
        "docs/commands.md, `## Flags of train`, against `train --help`"
    );
}

#[test]
fn every_flag_that_is_shown_exists() {
    let commands = [
        "train",
        "resume",
        "eval",
        "sweep",
        "report",
        "dashboard",
        "demos show",
        "demos convert",
        "record",
        "export",
        "push",
        "pull",
        "play",
        "bench rollout",
        "bench learner",
        "bench peers",
        "bench policy",
        "bench system",
        "bench scale",
        "bench transport",
        "bridge",
        "chaos",
        "tasks",
        "env add",
        "env remove",
        "doctor",
        "clean",
        "completions",
        "man",
        "learner",
        "actor",
        "evaluator",
        "observer",
    ];
    let words = |command: &str| -> BTreeSet<String> {
        flags(&help(&command.split(' ').collect::<Vec<_>>()))
    };
    let all: BTreeSet<_> = commands.iter().flat_map(|command| words(command)).collect();
    for document in documents() {
        let text = read(&document);
        for flag in spans(&text).iter().flat_map(|span| flags(span)) {
            let exists = all.contains(&flag) || FOREIGN.contains(&flag.as_str());
            assert!(exists, "{document} shows {flag}, which no command has");
        }
        // In a block the command is known, so the flag must belong to this command.
        for line in blocks(&text, "sh").iter().flat_map(|block| block.lines()) {
            let call = CALLS.iter().find_map(|call| line.split_once(call)).map(|(_, rest)| rest);
            let Some(rest) = call else { continue };
            let called = |command: &&&str| {
                rest.strip_prefix(**command)
                    .is_some_and(|more| more.is_empty() || more.starts_with(' '))
            };
            let command = commands.iter().find(called);
            let command = command.unwrap_or_else(|| panic!("{document}: `{line}`: no command"));
            let existing = words(command);
            let unknown: Vec<_> = flags(rest).difference(&existing).cloned().collect();
            assert!(unknown.is_empty(), "{document}: `{line}`: {command} has no {unknown:?}");
        }
    }
}

#[test]
fn every_configuration_key_that_is_named_exists() {
    const FILE_ENDINGS: [&str; 11] =
        ["npz", "jsonl", "json", "json5", "toml", "token", "safetensors", "svg", "rs", "md", "mp4"];
    let keys: BTreeSet<_> = Layers::new().keys().into_iter().collect();
    let sections: BTreeSet<_> = keys.iter().filter_map(|key| key.split('.').next()).collect();
    let mut seen = 0;
    for document in documents() {
        let text = read(&document);
        let allowed = |letter: char| letter.is_ascii_alphanumeric() || "._/".contains(letter);
        for word in text.split_inclusive(|letter: char| !allowed(letter)) {
            // A method: `policy.segment(observation)`.
            if word.ends_with('(') {
                continue;
            }
            let word = word.trim_end_matches(|letter| !allowed(letter)).trim_end_matches('.');
            let variable = word.strip_prefix("DMPRL_").filter(|rest| rest.contains("__"));
            let key = match variable {
                Some(variable) => variable.to_ascii_lowercase().replace("__", "."),
                None => word.to_owned(),
            };
            let Some((section, rest)) = key.split_once('.') else { continue };
            if !sections.contains(section) || FILE_ENDINGS.contains(&rest) {
                continue;
            }
            let below = format!("{key}.");
            // The environment decides which names are below this key.
            let exists = key.starts_with("task.kwargs.")
                || keys.iter().any(|it| *it == key || it.starts_with(&below));
            assert!(exists, "{document} names the key `{key}`, which does not exist");
            seen += 1;
        }
    }
    assert!(seen > 20, "only {seen} keys were recognised; has the notation changed?");
}

#[test]
fn the_keys_of_both_kinds_of_lines_are_documented() {
    let metrics = MetricsLine {
        workers: 0,
        queued_segments: 0,
        worker_restarts: 0,
        env_steps: 0,
        updates: 0,
        segments: 0,
        hindsight_segments: 0,
        policy_version: 0,
        replay_segments: 0,
        samples_per_insert: 0.0,
        rejected: Rejected::default(),
        critic_loss: None,
        actor_loss: None,
        q_mean: None,
        temperature: None,
        entropy: None,
        episodes: 0,
        training_return_mean: None,
        training_success_rate: None,
        policy_lag_p50: None,
        policy_lag_max: None,
        updates_owed: 0.0,
        lost: 0,
        delivery: DeliveryLine::default(),
        learner_restarts: 0,
        stale_segments: 0,
        policy_loss: None,
        value_loss: None,
        approx_kl: None,
        clip_fraction: None,
        env_failures: 0,
        wall_s: 0.0,
        env_steps_per_s: 0.0,
        updates_per_s: 0.0,
    };
    let evaluation = EvaluationRow {
        env_steps: 0,
        updates: 0,
        segments: 0,
        wall_s: 0.0,
        policy_version: 0,
        returns: Vec::new(),
        return_mean: 0.0,
        success_rate: None,
        smoothness: 0.0,
        at_bounds: None,
    };
    let page = read("docs/metrics.md");
    let lines = [
        ("## A line of metrics.jsonl", serde_json::to_value(metrics).unwrap()),
        ("## A line of evaluations.jsonl", serde_json::to_value(evaluation).unwrap()),
    ];
    for (heading, line) in lines {
        let written: BTreeSet<_> = line.as_object().unwrap().keys().cloned().collect();
        assert_eq!(first_cells(section(&page, heading)), written, "docs/metrics.md, `{heading}`");
    }
}

#[test]
fn every_path_and_test_that_the_documents_name_exists() {
    const FOLDERS: [&str; 8] =
        ["actors/", "deploy/", "docs/", "envs_py/", "learner/", "shared/", "tests/", ".ci/"];
    for document in documents() {
        let text = read(&document);
        let links = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        let links = links.filter(|link| !link.contains("://")).map(str::to_owned);
        let named = spans(&text).into_iter().filter(|span| {
            FOLDERS.iter().any(|folder| span.starts_with(folder)) && !span.contains(' ')
        });
        for name in links.chain(named) {
            if let Some(anchor) = name.strip_prefix('#') {
                let headings = text.lines().filter(|line| line.starts_with('#'));
                let found = headings.map(anchor_of).any(|heading| heading == anchor);
                assert!(found, "{document} names #{anchor}, which no heading has");
                continue;
            }
            let (path, test) = name.split_once("::").unwrap_or((&name, ""));
            // The book's test checks headings of other pages.
            let path = path.split('#').next().unwrap_or(path);
            // A link is relative to its document, a path in code to the project.
            let beside = Path::new(&document).parent().unwrap_or(Path::new(""));
            let there = [root().join(path), root().join(beside).join(path)];
            assert!(
                there.iter().any(|path| path.exists()),
                "{document} names {path}, which does not exist"
            );
            let there = test.is_empty() || read(path).contains(&format!("fn {test}("));
            assert!(there, "{document} names the test {test}, which {path} does not have");
        }
    }
}

/// Returns the anchor of a heading.
fn anchor_of(heading: &str) -> String {
    let words = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = words.chars().filter(|letter| letter.is_alphanumeric() || " -_".contains(*letter));
    kept.collect::<String>().replace(' ', "-")
}

#[test]
fn continuous_integration_runs_the_readmes_test_command() {
    let command = "cargo test --release";
    assert!(blocks(&read("README.md"), "sh").iter().any(|block| block == command));
    assert!(read(".ci/run").lines().any(|line| line == command), ".ci/run lacks `{command}`");
    assert!(read(".github/workflows/ci.yml").contains("- run: .ci/run"));
}

// A tag can be moved to other code.
#[test]
fn actions_are_named_by_commits() {
    for entry in std::fs::read_dir(root().join(".github/workflows")).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap();
        let used = text.lines().filter_map(|line| line.split_once("uses: "));
        for (_, action) in used {
            let (_, commit) = action.split_once('@').unwrap();
            let commit = commit.split(' ').next().unwrap();
            let is_commit = commit.len() == 40 && commit.bytes().all(|it| it.is_ascii_hexdigit());
            assert!(is_commit, "{}: {action}", path.display());
        }
    }
}
