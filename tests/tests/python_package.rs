//! Runs the Python package's own tests in the environment that the program makes.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::process::Command;

use dmprl_tests::skipped::skipped;
use dmprl_tests::{project_root, venv};
use toml::Table;

/// Version of the package.
const ONLY_FOR_TESTS: &str = "test";

#[test]
fn unit_tests_of_the_python_package_pass() {
    let output = Command::new(&venv().executable)
        .args(["-W", "error::SyntaxWarning", "-m", "unittest", "discover", "envs_py/tests"])
        // Names the tests that are skipped.
        .arg("--verbose")
        .current_dir(project_root())
        .output()
        .unwrap();
    let report = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{report}");
    assert!(!report.contains("Ran 0 tests"), "{report}");
    for (_, reason) in report.lines().filter_map(|line| line.split_once("... skipped ")) {
        let what = format!("tests of the Python package: {}", reason.trim_matches(['\'', '"']));
        skipped("TEST_OPENGL_REQUIRED", &what, "apt install libegl1 libgl1-mesa-dri");
    }
}

#[test]
fn package_alone_and_with_the_program_ask_for_the_same() {
    let project = |manifest: &str| {
        let text = std::fs::read_to_string(project_root().join(manifest)).unwrap();
        let manifest: Table = text.parse().unwrap();
        let mut project = manifest["project"].as_table().unwrap().clone();
        // The program's Python, and the command.
        let of_the_program = ["requires-python", "scripts"];
        let of_the_text = ["description", "readme", "license-files"];
        for of_its_own in [&of_the_program[..], &of_the_text].concat() {
            project.remove(of_its_own);
        }
        let extras = project.get_mut("optional-dependencies").unwrap().as_table_mut().unwrap();
        extras.remove(ONLY_FOR_TESTS);
        project
    };
    let package = project("envs_py/pyproject.toml");
    assert_eq!(project("pyproject.toml"), package);
    assert_eq!(package["version"].as_str().unwrap(), env!("CARGO_PKG_VERSION"));
}

#[test]
fn the_version_and_the_address_are_the_same_everywhere() {
    let text = |file: &str| std::fs::read_to_string(project_root().join(file)).unwrap();
    let citation = text("CITATION.cff");
    for (key, value) in
        [("version", env!("CARGO_PKG_VERSION")), ("repository-code", env!("CARGO_PKG_REPOSITORY"))]
    {
        let line = format!("{key}: {value}");
        assert!(citation.lines().any(|it| it == line), "CITATION.cff lacks the line {line:?}");
    }
    let released = citation.lines().find_map(|line| line.strip_prefix("date-released: ")).unwrap();
    let heading = format!("## [{}] - {released}\n", env!("CARGO_PKG_VERSION"));
    assert!(text("CHANGELOG.md").contains(&heading), "CHANGELOG.md lacks {heading:?}");
    let assignment = format!("__version__ = \"{}\"\n", env!("CARGO_PKG_VERSION"));
    assert!(text("envs_py/dmprl/__init__.py").contains(&assignment), "{assignment}");
}
