//! The Python package's own tests, in the environment that the program makes.
#![cfg(feature = "python")]
#![allow(
    clippy::unwrap_used,
    reason = "helpers of tests; clippy.toml covers only the tests themselves"
)]

use std::process::Command;

use dmprl_tests::{project_root, venv};

#[test]
fn unit_tests_of_the_python_package_pass() {
    let output = Command::new(&venv().executable)
        .args(["-W", "error::SyntaxWarning", "-m", "unittest", "discover", "envs_py/tests"])
        .current_dir(project_root())
        .output()
        .unwrap();
    let report = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{report}");
    assert!(!report.contains("Ran 0 tests"), "{report}");
}
