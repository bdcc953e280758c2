//! Scripts, units and the Compose file, by the programs that will read them. Where one of these is
//! not installed there is nothing to ask, and the test says so and passes.

use std::fs;
use std::io::Write;
use std::process::{Command, Output};

use dmprl_tests::project_root;

use super::read;

/// What a program says; none if there is no such program.
fn asked(program: &str, arguments: &[&str]) -> Option<Output> {
    match Command::new(program).args(arguments).current_dir(project_root()).output() {
        Ok(output) => Some(output),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            // Not `eprintln!`, which the harness keeps to itself when a test passes.
            writeln!(std::io::stderr().lock(), "there is no {program} here to ask").unwrap();
            None
        }
        Err(error) => panic!("{program}: {error}"),
    }
}

fn approved(program: &str, arguments: &[&str]) {
    let Some(output) = asked(program, arguments) else { return };
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{program} {arguments:?}: {said}{:?}", output.stdout);
}

#[test]
fn bash_and_its_linter_approve_of_the_slurm_script() {
    approved("bash", &["-n", "deploy/slurm/train.sbatch"]);
    approved("shellcheck", &["deploy/slurm/train.sbatch"]);
}

/// `systemd-analyze` wants to see the program, so another takes its place.
#[test]
fn systemd_approves_of_the_units() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["dmprl-train@.service", "dmprl-bridge@.service"] {
        let unit = read(&format!("deploy/systemd/{name}"));
        assert!(unit.contains("/opt/dmprl/bin/dmprl "), "{name}");
        let path = folder.path().join(name);
        fs::write(&path, unit.replace("/opt/dmprl/bin/dmprl", "/bin/true")).unwrap();
        let arguments = ["verify", "--man=no", path.to_str().unwrap()];
        let Some(output) = asked("systemd-analyze", &arguments) else { return };
        // It ends well whatever it says about keys that it does not know.
        let said = String::from_utf8_lossy(&output.stderr);
        let of_ours: Vec<_> = said.lines().filter(|line| line.contains("dmprl")).collect();
        assert!(output.status.success() && of_ours.is_empty(), "{of_ours:?}");
    }
}

/// A unit that hides too much, or cleans up after others, breaks runs in ways that only a host with
/// systemd shows.
#[test]
fn units_leave_shared_memory_alone_and_stop_the_supervisor_first() {
    for name in ["dmprl-train@.service", "dmprl-bridge@.service"] {
        let unit = read(&format!("deploy/systemd/{name}"));
        let has = |line: &str| unit.lines().any(|it| it == line);
        for line in ["RemoveIPC=no", "KillMode=mixed", "RestartPreventExitStatus=2"] {
            assert!(has(line), "{name}: no {line}");
        }
        // The last two hide GPUs.
        for key in ["DynamicUser=", "MemoryDenyWriteExecute=", "PrivateDevices=", "ProtectClock="] {
            assert!(!unit.lines().any(|line| line.starts_with(key)), "{name}: {key}");
        }
    }
}

#[test]
fn compose_approves_of_its_file() {
    let Some(version) = asked("docker", &["compose", "version"]) else { return };
    if !version.status.success() {
        writeln!(std::io::stderr().lock(), "docker has no compose here to ask").unwrap();
        return;
    }
    approved("docker", &["compose", "--file", "deploy/compose.yaml", "config", "--quiet"]);
}

/// The same with no program at all: what the file must say.
#[test]
fn compose_file_gives_shared_memory_and_no_rights() {
    let file: serde_yaml_ng::Value = serde_yaml_ng::from_str(&read("deploy/compose.yaml")).unwrap();
    let mut file = file;
    file.apply_merge().unwrap();
    let services = serde_json::to_value(&file["services"]).unwrap();
    for (name, service) in services.as_object().unwrap() {
        assert_eq!(service["read_only"], true, "{name}");
        assert_eq!(service["cap_drop"][0], "ALL", "{name}");
        assert!(service["restart"].as_str().unwrap().starts_with("on-failure:"), "{name}");
        assert!(service.get("ports").is_none(), "{name} is nobody's to reach");
    }
    for name in ["learner", "workers"] {
        assert!(services[name]["shm_size"].is_string(), "{name}");
    }
}
