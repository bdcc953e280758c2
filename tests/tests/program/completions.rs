//! Shell completions and manual pages.

use std::fs;
use std::process::Command;

use dmprl_tests::program::Workplace;

#[test]
fn bash_completes_commands_and_flags() {
    let place = Workplace::new();
    let script = place.run(&["completions", "bash"]).with_status(0).printed;
    let path = place.path("dmprl.bash");
    fs::write(&path, script).unwrap();
    let completed = |words: &str| {
        let line = format!(
            "source {path}; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); \
             _dmprl dmprl \"${{COMP_WORDS[-1]}}\" \"${{COMP_WORDS[-2]}}\"; \
             echo \"${{COMPREPLY[@]}}\""
        );
        let output = Command::new("bash").args(["-c", &line]).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    assert_eq!(completed("dmprl tra").trim(), "train");
    assert!(completed("dmprl bench po").contains("policy"));
    assert!(completed("dmprl export --form").contains("--format"));
    // Roles are not for users.
    assert_eq!(completed("dmprl obs").trim(), "");
}

#[test]
fn every_command_has_a_manual_page() {
    let place = Workplace::new();
    place.run(&["man", "--output", "pages"]).with_status(0);
    let page = |name: &str| fs::read_to_string(place.path(&format!("pages/{name}.1")));
    for name in ["dmprl", "dmprl-train", "dmprl-bench-policy", "dmprl-sweep"] {
        let page = page(name).unwrap();
        let named = name.replace('-', "\\-");
        assert!(page.contains(".SH SYNOPSIS") && page.contains(&named), "{page}");
    }
    assert!(page("dmprl-observer").is_err(), "roles are not for people");
}
