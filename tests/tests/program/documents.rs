//! Runs the code blocks of README and the book in order, each page in a folder that looks like a
//! clone.
//!
//! - `sh` runs in bash; `cargo` and `dmprl` are the program itself with less to do
//!   (`tests/documents/stand_in.py`), and a loop over seeds runs only the first.
//! - `python` runs in the interpreter of `.venv`.
//! - `file=NAME` after the language saves the block under that name, for later blocks.
//! - `not-run` after the language marks a block that a test cannot run. Its first line is a comment
//!   with the reason. Their number is limited.
//! - `text`, `json` and `math` are not run: output, equations, and commands for a cluster, a
//!   container engine or systemd, whose files `tests/tests/placement/main.rs` checks.

use std::fmt::Write;
use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::Command;

use dmprl_tests::program::{Workplace, executable};
use dmprl_tests::{project_root, venv};

use super::record::can_draw;

/// Maximum number of `not-run` blocks in all pages.
const NOT_RUN_MAX: usize = 7;
/// Files of a clone that blocks name.
const OF_A_CLONE: [&str; 6] = [".venv", "deploy", "docs", "envs_py", "tests", "ARCHITECTURE.md"];
/// Small networks and few updates, unless a block sets them.
const SMALL: [(&str, &str); 8] = [
    ("DMPRL_POLICY__HIDDEN", "[16]"),
    ("DMPRL_ALGORITHM__CRITIC_HIDDEN", "[16]"),
    ("DMPRL_ALGORITHM__BATCH_SIZE", "16"),
    ("DMPRL_ALGORITHM__NDP__ROLLOUT_SEGMENTS", "16"),
    ("DMPRL_ALGORITHM__NDP__EPOCHS", "1"),
    ("DMPRL_ALGORITHM__NDP__MINIBATCHES", "2"),
    ("DMPRL_DEMONSTRATIONS__CLONING_UPDATES", "20"),
    ("DMPRL_EVALUATION__EPISODES", "2"),
];

macro_rules! pages {
    ($($(#[$attribute:meta])* $test:ident: $path:literal,)*) => {
        /// Pages with code blocks.
        const PAGES: &[&str] = &[$($path),*];
        $(
            $(#[$attribute])*
            #[test]
            fn $test() {
                follow($path);
            }
        )*
    };
}

pages! {
    every_block_of_the_readme_runs: "README.md",
    every_block_of_the_first_page_runs: "docs/index.md",
    every_block_about_the_start_runs: "docs/start.md",
    every_block_about_a_task_of_ones_own_runs: "docs/own-task.md",
    every_block_about_a_picked_cube_runs: "docs/picked-cube.md",
    every_block_about_commands_runs: "docs/commands.md",
    every_block_about_environments_runs: "docs/environments.md",
    every_block_about_demonstrations_runs: "docs/demonstrations.md",
    every_block_about_configuration_runs: "docs/configuration.md",
    every_block_about_runs_runs: "docs/runs.md",
    every_block_about_the_dashboard_runs: "docs/dashboard.md",
    every_block_about_sweeps_runs: "docs/sweeps.md",
    every_block_about_robots_runs: "docs/robot.md",
    every_block_about_python_runs: "docs/python.md",
    every_block_about_workers_runs: "docs/workers.md",
    #[cfg(feature = "hosts")]
    every_block_about_several_hosts_runs: "docs/several-hosts.md",
    every_block_about_trouble_runs: "docs/troubleshooting.md",
    every_block_about_results_runs: "docs/results.md",
    every_block_about_benchmarks_runs: "docs/benchmarks.md",
    every_block_about_trained_policies_runs: "docs/zoo.md",
    every_block_about_sharing_runs: "docs/sharing.md",
    every_block_about_an_algorithm_of_ones_own_runs: "docs/own-algorithm.md",
}

/// A fenced block of code.
struct Block {
    /// Page and line.
    at: String,
    language: String,
    attributes: Vec<String>,
    text: String,
}

impl Block {
    fn is_run(&self) -> bool {
        // An included file is compiled with the project.
        let is_included = self.text.trim_start().starts_with("{{#include ");
        let is_read = is_included || ["text", "json", "math"].contains(&self.language.as_str());
        !self.has("not-run") && !is_read
    }

    fn has(&self, attribute: &str) -> bool {
        self.attributes.iter().any(|it| it == attribute)
    }
}

fn blocks(page: &str) -> Vec<Block> {
    let text = fs::read_to_string(project_root().join(page)).unwrap();
    let mut blocks: Vec<Block> = Vec::new();
    let mut open = false;
    for (index, line) in text.lines().enumerate() {
        // A block in a list is indented with its text.
        match (line.trim_start().strip_prefix("```"), open) {
            (Some(""), true) => open = false,
            (Some(info), false) => {
                let mut words = info.split(',').map(str::to_owned);
                let language = words.next().unwrap();
                let at = format!("{page}:{}", index + 1);
                assert!(!language.is_empty(), "{at}: say the block's language");
                blocks.push(Block {
                    at,
                    language,
                    attributes: words.collect(),
                    text: String::new(),
                });
                open = true;
            }
            (_, true) => writeln!(blocks.last_mut().unwrap().text, "{line}").unwrap(),
            (_, false) => {}
        }
    }
    assert!(!open, "{page}: a block has no end");
    blocks
}

fn follow(page: &str) {
    let place = Workplace::new();
    settle(&place);
    let blocks: Vec<_> = blocks(page).into_iter().filter(Block::is_run).collect();
    assert!(!blocks.is_empty(), "{page} has nothing to run: take it out of `pages!`");
    // Checked only where a block draws, because it takes a second.
    let draws = |block: &Block| ["record", "play"].iter().any(|word| block.text.contains(word));
    let can_draw = !blocks.iter().any(draws) || can_draw();
    for block in blocks {
        if let Some(name) = block.attributes.iter().find_map(|it| it.strip_prefix("file=")) {
            fs::write(place.path(name), &block.text).unwrap();
            continue;
        }
        let mut command = match block.language.as_str() {
            "sh" => {
                let mut command = Command::new("bash");
                command.args(["-euo", "pipefail", "-c"]);
                command.arg(block.text.replace("for seed in 1 2 3;", "for seed in 1;"));
                command
            }
            "python" => {
                let mut command = Command::new(&venv().executable);
                command.args(["-c", &block.text]);
                command
            }
            other => panic!("{}: `{other}` is neither run nor saved (file=NAME)", block.at),
        };
        command.envs(SMALL).env("PATH", search_path(&place));
        command.env("PYTHONPATH", project_root().join("envs_py"));
        if !can_draw {
            command.env("STAND_IN_CANNOT_DRAW", "1");
        }
        command.env("STAND_IN_PROGRAM", executable()).env("STAND_IN_PROJECT", project_root());
        let ended = place.start_command(command).wait();
        assert!(
            ended.status.success(),
            "{}: {}\n{}\n{}{}",
            block.at,
            ended.status,
            block.text,
            ended.printed,
            ended.said
        );
    }
    place.until_no_process();
}

/// Makes the folder look like a clone, with `cargo` and `dmprl` in its search path.
fn settle(place: &Workplace) {
    for name in OF_A_CLONE {
        symlink(project_root().join(name), place.path(name)).unwrap();
    }
    let stand_in = project_root().join("tests/documents/stand_in.py");
    fs::create_dir(place.path("bin")).unwrap();
    fs::create_dir_all(place.path("target/release")).unwrap();
    for (path, called) in
        [("bin/cargo", "cargo"), ("bin/dmprl", "dmprl"), ("target/release/dmprl", "dmprl")]
    {
        let python = venv().executable.display();
        let text = format!("#!/bin/sh\nexec {python} {} {called} \"$@\"\n", stand_in.display());
        fs::write(place.path(path), text).unwrap();
        fs::set_permissions(place.path(path), fs::Permissions::from_mode(0o755)).unwrap();
    }
}

fn search_path(place: &Workplace) -> String {
    format!("{}:{}", place.path("bin"), std::env::var("PATH").unwrap())
}

/// Returns README and the pages of `docs/` that people write, without tables of contents and
/// reports.
fn written_pages() -> Vec<String> {
    let mut pages = vec!["README.md".to_owned()];
    for entry in fs::read_dir(project_root().join("docs")).unwrap().flatten() {
        let name = entry.file_name().into_string().unwrap();
        if Path::new(&name).extension().is_some_and(|it| it == "md") {
            pages.push(format!("docs/{name}"));
        }
    }
    pages
}

#[test]
fn every_page_with_code_is_followed() {
    for page in written_pages() {
        let has_code = blocks(&page).iter().any(Block::is_run);
        assert!(
            !has_code || PAGES.contains(&page.as_str()),
            "{page} has code blocks: add it to `pages!` in {}",
            file!()
        );
    }
}

#[test]
fn what_is_not_run_says_why_and_is_rare() {
    let mut not_run = Vec::new();
    for page in written_pages() {
        for block in blocks(&page).into_iter().filter(|block| block.has("not-run")) {
            let why = block.text.lines().next().unwrap_or_default();
            assert!(why.starts_with("# "), "{}: the first line says why it is not run", block.at);
            not_run.push(block.at);
        }
    }
    assert!(
        not_run.len() <= NOT_RUN_MAX,
        "{} blocks are not run, at most {NOT_RUN_MAX}: {not_run:?}",
        not_run.len()
    );
}

/// Promises of the pages.
#[test]
fn a_task_has_thirty_lines_and_a_policy_acts_in_three() {
    let lines = |page: &str| {
        let python = blocks(page).into_iter().find(|block| block.language == "python").unwrap();
        python.text.lines().filter(|line| !line.is_empty()).count()
    };
    assert!(lines("docs/own-task.md") <= 30);
    assert!(lines("README.md") <= 3);
}
