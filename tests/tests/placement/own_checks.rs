//! Scripts, units and the Compose file, checked by the programs that read them. A test whose
//! program is not installed is skipped.

use std::fs;
use std::process::{Command, Output};

use dmprl_tests::project_root;
use dmprl_tests::skipped::skipped;

use super::read;

const REQUIRED_BY: &str = "TEST_TOOLS_REQUIRED";

/// Runs a program in the project's directory; `None` if it is not installed.
fn asked(program: &str, arguments: &[&str]) -> Option<Output> {
    match Command::new(program).args(arguments).current_dir(project_root()).output() {
        Ok(output) => Some(output),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => panic!("{program}: {error}"),
    }
}

fn assert_approved(output: &Output) {
    let [printed, said] = [&output.stdout, &output.stderr].map(|it| String::from_utf8_lossy(it));
    assert!(output.status.success(), "{said}{printed}");
}

#[test]
fn bash_and_its_linter_approve_of_the_scripts() {
    let slurm = ["deploy/slurm/train.sbatch", "deploy/slurm/sweep.sbatch"];
    let checks = [".ci/run", ".ci/installed", ".ci/advisories", ".ci/cuda", ".ci/tools.sh"];
    let scripts = ["deploy/lock.sh", "deploy/release.sh"];
    for script in slurm.into_iter().chain(checks).chain(scripts) {
        assert_approved(&asked("bash", &["-n", script]).expect("bash"));
        match asked("shellcheck", &["--external-sources", script]) {
            Some(output) => assert_approved(&output),
            None => skipped(REQUIRED_BY, script, "apt install shellcheck"),
        }
    }
}

/// `systemd-analyze` requires that the program exists, so another one replaces it.
#[test]
fn systemd_approves_of_the_units() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["dmprl-train@.service", "dmprl-bridge@.service"] {
        let unit = read(&format!("deploy/systemd/{name}"));
        assert!(unit.contains("/opt/dmprl/bin/dmprl "), "{name}");
        let path = folder.path().join(name);
        fs::write(&path, unit.replace("/opt/dmprl/bin/dmprl", "/bin/true")).unwrap();
        let arguments = ["verify", "--man=no", path.to_str().unwrap()];
        let Some(output) = asked("systemd-analyze", &arguments) else {
            skipped(REQUIRED_BY, "the units of systemd", "apt install systemd");
            return;
        };
        // It exits with 0 even after warnings about unknown keys.
        let said = String::from_utf8_lossy(&output.stderr);
        let of_ours: Vec<_> = said.lines().filter(|line| line.contains("dmprl")).collect();
        assert!(output.status.success() && of_ours.is_empty(), "{of_ours:?}");
    }
}

/// A unit that hides too much or removes other files breaks runs only on hosts with systemd.
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

/// Docker itself, or check-jsonschema with the schema of the Compose specification.
#[test]
fn compose_approves_of_its_file() {
    const FILE: &str = "deploy/compose.yaml";
    let version = asked("docker", &["compose", "version"]);
    if version.is_some_and(|output| output.status.success()) {
        let arguments = ["compose", "--file", FILE, "config", "--quiet"];
        return assert_approved(&asked("docker", &arguments).expect("docker"));
    }
    let schema = ["--builtin-schema", "vendor.compose-spec"];
    match asked("check-jsonschema", &[&schema[..], &[FILE]].concat()) {
        Some(output) => {
            assert_approved(&output);
            // It must reject an invalid file.
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("compose.yaml");
            fs::write(&path, read(FILE).replace("restart: on-failure:5", "restarts: 5")).unwrap();
            let wrong =
                asked("check-jsonschema", &[&schema[..], &[path.to_str().unwrap()]].concat());
            assert!(!wrong.unwrap().status.success());
        }
        None => skipped(REQUIRED_BY, FILE, "pip install check-jsonschema"),
    }
}

#[test]
fn apptainer_builds_from_the_images_and_sources_of_the_dockerfile() {
    let (recipe, dockerfile) = (read("deploy/apptainer.def"), read("deploy/Dockerfile"));
    // `rust:1.98-slim-trixie@sha256:…` there is `rust@sha256:…` here.
    let image = |argument: &str| {
        let prefix = format!("ARG {argument}=");
        let image = dockerfile.lines().find_map(|line| line.strip_prefix(&prefix)).unwrap();
        let (tagged, digest) = image.split_once("@sha256:").expect("an image has a digest");
        assert!(digest.len() == 64 && digest.bytes().all(|byte| byte.is_ascii_hexdigit()));
        format!("{}@sha256:{digest}", tagged.split_once(':').unwrap().0)
    };
    let (rust, python) = (image("RUST_IMAGE"), image("PYTHON_IMAGE"));
    let used: Vec<_> = recipe.lines().filter_map(|line| line.strip_prefix("From: ")).collect();
    assert_eq!(used, [&rust, &python, &python]);
    let ignored = read("deploy/Dockerfile.dockerignore");
    for source in ignored.lines().filter_map(|line| line.strip_prefix('!')) {
        let name = source.trim_end_matches('*');
        assert!(recipe.contains(&format!("    {name}")), "{source} is not copied");
    }
}
