//! Resources that a start requires, and protection of a run from other users.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use dmprl_tests::program::{
    Workplace, env_steps_of, executable, json_file, rows, shared_memory_of,
};
use dmprl_tests::skipped::skipped;
use rustix::process::Signal;

use crate::{ENDLESS, train};

/// A user that owns no file here.
const STRANGER: &str = "65534";

/// Returns each entry below a directory, and the directory itself.
fn tree(path: &Path) -> Vec<PathBuf> {
    let mut paths = vec![path.to_owned()];
    if path.symlink_metadata().unwrap().is_dir() {
        let below = fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path());
        paths.extend(below.flat_map(|path| tree(&path)));
    }
    paths
}

fn refused_by_its_size(command: Command, place: &Workplace, words: &[&str]) {
    let mut finished = place.start_command(command).wait().with_status(1);
    for word in ["the run exceeds this machine's resources"].iter().chain(words) {
        finished = finished.saying(word);
    }
    assert_eq!(fs::read_dir(place.folder()).unwrap().count(), 0, "it was refused before it began");
}

#[test]
fn a_run_that_shared_memory_cannot_hold_is_refused_with_both_numbers() {
    let place = Workplace::new();
    let run = place.path("run");
    let huge = [
        "--workers",
        "1024",
        "--set",
        "actors.queue_segments=65536",
        "--set",
        "policy.segment_steps=200",
        "--set",
        "dmp.integration_steps=200",
    ];
    let mut command = Command::new(executable());
    command.args(train("pusher", &run, &huge));
    let words = ["TiB needed for 1024 workers", "free in /dev/shm", "--shm-size"];
    refused_by_its_size(command, &place, &words);
}

/// Returns a command with its own /dev/shm of this size [KiB], as in a container; `None`, and the
/// test is skipped, if it cannot be mounted.
pub(crate) fn with_shared_memory_of(kib: u32, script: &str) -> Option<Command> {
    let mount = format!("mount -t tmpfs -o size={kib}k,mode=1777 tmpfs /dev/shm");
    let alone = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "sh", "-c", script]);
        command
    };
    let probe = alone(&mount).output();
    if probe.is_ok_and(|output| output.status.success()) {
        return Some(alone(&format!("{mount} && {script}")));
    }
    let remedy = "run the tests as root, where it may mount";
    skipped("TEST_ROOT_REQUIRED", "runs with a small /dev/shm", remedy);
    None
}

#[test]
fn a_container_with_too_little_shared_memory_is_told_before_it_starts() {
    let place = Workplace::new();
    let run = place.path("run");
    let line = train("reacher", &run, &["--workers", "2"]).join(" ");
    let script = format!("exec {} {line}", executable().display());
    let Some(command) = with_shared_memory_of(256, &script) else { return };
    let words =
        ["needed for 2 workers and 4 that may join", "256 KiB free in /dev/shm", "--shm-size"];
    refused_by_its_size(command, &place, &words);
}

/// Docker's default suffices for a default run, and doctor reports this with the numbers.
#[test]
fn dockers_shared_memory_is_enough_and_worth_a_warning() {
    let place = Workplace::new();
    let run = place.path("run");
    let line = train("reacher", &run, &["--steps", "500", "--workers", "1"]).join(" ");
    let program = executable().display();
    let script = format!("{program} doctor; exec {program} {line}");
    let Some(command) = with_shared_memory_of(64 << 10, &script) else { return };
    let finished = place.start_command(command).wait().with_status(0);
    // With many cores a default run has many workers and does not fit.
    let warning = |line: &str| {
        line.contains(" shared memory ")
            && line.contains("needs")
            && line.contains("64 MiB in /dev/shm")
            && !line.starts_with("ok")
    };
    assert!(finished.printed.lines().any(warning), "{}", finished.printed);
}

#[test]
fn too_few_open_files_are_refused_with_both_numbers() {
    let place = Workplace::new();
    let run = place.path("run");
    let line = train("reacher", &run, &["--workers", "4"]).join(" ");
    let mut command = Command::new("bash");
    command.args(["-c", &format!("ulimit -n 64; exec {} {line}", executable().display())]);
    refused_by_its_size(command, &place, &["open files: 160 needed", "the limit is 64"]);
}

#[test]
fn resume_asks_for_the_same_room_and_leaves_the_run_as_it_is() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "500"])).with_status(0);
    let manifest = fs::read(Path::new(&run).join("manifest.json")).unwrap();
    let mut command = Command::new("bash");
    let program = executable().display();
    command.args(["-c", &format!("ulimit -n 40; exec {program} resume {run} --steps 1000")]);
    place.start_command(command).wait().with_status(1).saying("the limit is 40");
    assert_eq!(fs::read(Path::new(&run).join("manifest.json")).unwrap(), manifest);
}

/// The numbers that a start is checked against are upper bounds of a run's real use.
#[test]
fn what_is_asked_for_covers_what_a_run_takes() {
    /// The run's own workers and those that may join.
    const WORKERS: usize = 4 + 4;
    let place = Workplace::new();
    let run = place.path("run");
    let more = ["--steps", ENDLESS, "--workers", "4"];
    let mut running = place.start(&train("reacher", &run, &more));
    running.until_steps(&run, 1_500);
    for process in place.processes() {
        let of = |what| PathBuf::from(format!("/proc/{}/{what}", process.id.as_raw_nonzero()));
        let files = fs::read_dir(of("fd")).unwrap().count();
        let maps = fs::read_to_string(of("maps")).unwrap().lines().count();
        println!("{}: {files} files, {maps} maps", process.role);
        assert!(files <= 64 + 12 * WORKERS, "{}: {files} files", process.role);
        assert!(maps <= 1_024 + 12 * WORKERS, "{}: {maps} maps", process.role);
    }
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
}

#[test]
fn two_runs_of_one_user_at_once_have_nothing_in_common() {
    let place = Workplace::new();
    let runs = [place.path("one"), place.path("two")];
    let mut running = runs.each_ref().map(|run| {
        let mut running = place.start(&train("reacher", run, &["--steps", ENDLESS]));
        running.until_steps(run, 500);
        running
    });
    let domains = runs.each_ref().map(|run| shared_memory_of(run));
    assert!(domains.iter().all(|domain| domain.len() == 1), "{domains:?}");
    assert_ne!(domains[0], domains[1]);
    for (run, running) in runs.iter().zip(&mut running) {
        let steps = env_steps_of(run).unwrap();
        running.until_steps(run, steps + 1_000);
    }
    // Each process maps the shared memory of its own run only.
    for process in place.processes() {
        let maps = format!("/proc/{}/maps", process.id.as_raw_nonzero());
        let maps = fs::read_to_string(maps).unwrap_or_default();
        let mapped = |index: usize| maps.contains(domains[index][0].to_str().unwrap());
        assert!(!(mapped(0) && mapped(1)), "{process:?}");
    }
    for (run, running) in runs.iter().zip(running) {
        running.signal_group(Signal::INT);
        running.wait().with_status(130);
        let last = rows(run, "metrics.jsonl").pop().unwrap();
        let rejected = last["rejected"].as_object().unwrap();
        assert!(rejected.values().all(|count| count == 0), "{last}");
        assert_eq!(last["lost"], 0, "{last}");
    }
    let id = |run: &String| json_file(run, "manifest.json")["run_id"].clone();
    assert_ne!(id(&runs[0]), id(&runs[1]));
}

fn as_stranger(script: &str) -> Output {
    let stranger = ["--reuid", STRANGER, "--regid", STRANGER, "--clear-groups", "sh", "-c"];
    Command::new("setpriv").args(stranger).arg(script).output().unwrap()
}

#[test]
fn another_user_can_neither_read_nor_inject_nor_block() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    running.until_steps(&run, 500);
    let [domain] = &shared_memory_of(&run)[..] else { panic!("one domain") };
    for path in tree(domain) {
        let metadata = path.symlink_metadata().unwrap();
        assert_eq!(metadata.uid(), domain.metadata().unwrap().uid());
    }
    for directory in [domain.as_path(), domain.parent().unwrap()] {
        assert_eq!(directory.metadata().unwrap().permissions().mode() & 0o7777, 0o700);
    }
    let lock = Path::new(&run).join("lock");
    assert_eq!(
        lock.metadata().unwrap().permissions().mode() & 0o077,
        0,
        "who opens it can hold it"
    );

    let probe = Command::new("setpriv").args(["--reuid", STRANGER, "true"]).status();
    if !rustix::process::geteuid().is_root() || !probe.is_ok_and(|status| status.success()) {
        let remedy = "run the tests as root, with setpriv (apt install util-linux)";
        return skipped("TEST_ROOT_REQUIRED", "a run that another user attacks", remedy);
    }
    // As on a shared machine, all users can reach the run's directory.
    fs::set_permissions(place.folder(), PermissionsExt::from_mode(0o755)).unwrap();
    let marker = domain.join("domain");
    let [domain, marker, lock] = [domain, &marker, &lock].map(|path| path.display().to_string());
    for script in [
        format!("ls {domain}"),
        format!("cat {marker}"),
        format!("echo forged > {marker}"),
        format!("touch {domain}/g1/forged"),
        format!("mkdir {domain}-squatted"),
        format!("rm -rf {domain}"),
        format!("mv {domain} {domain}-moved"),
        format!("flock --nonblock {lock} true"),
    ] {
        let output = as_stranger(&script);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success(), "{script}");
        assert!(said.contains("ermission denied"), "{script}: {said}");
    }
    let steps = env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 500);
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
}

/// A module of the working directory must not replace one of Python's.
#[test]
fn nothing_of_the_working_directory_or_of_pythons_variables_is_imported() {
    let place = Workplace::new();
    let run = place.path("run");
    let elsewhere = place.folder().join("elsewhere");
    fs::create_dir(&elsewhere).unwrap();
    let trap = "raise SystemExit('imported from the wrong place')";
    for folder in [place.folder(), &elsewhere] {
        for module in ["gymnasium.py", "numpy.py", "sitecustomize.py", "usercustomize.py"] {
            fs::write(folder.join(module), trap).unwrap();
        }
    }
    // iceoryx2 would read this file if it were not given another.
    fs::create_dir(place.folder().join("config")).unwrap();
    fs::write(place.folder().join("config/iceoryx2.toml"), "no = [ TOML").unwrap();
    let mut command = Command::new(executable());
    command.args(train("reacher", &run, &["--steps", "500"]));
    command.env("PYTHONPATH", &elsewhere).env("PYTHONSTARTUP", elsewhere.join("numpy.py"));
    place.start_command(command).wait().with_status(0);
}

#[test]
fn the_processes_of_a_run_gain_no_privileges_and_leave_no_core_dumps() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    running.until_steps(&run, 1_500);
    let mut joined = place.start(&["actor", "--join", &run]);
    joined.until_said("segments sent");
    let roles = ["learner", "evaluator", "actor"];
    let processes: Vec<_> = place
        .processes()
        .into_iter()
        .filter(|process| roles.contains(&process.role.as_str()))
        .collect();
    let joined_too = processes.len() == roles.len() + 1;
    assert!(joined_too, "one each, and the worker that joined: {processes:#?}");
    for process in processes {
        let folder = PathBuf::from(format!("/proc/{}", process.id.as_raw_nonzero()));
        let line = |what: &str, name: &str| {
            let text = fs::read_to_string(folder.join(what)).unwrap();
            let line = text.lines().find(|line| line.starts_with(name)).unwrap().to_owned();
            line[name.len()..].split_whitespace().map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(line("status", "NoNewPrivs:"), ["1"], "{process:?}");
        assert_eq!(line("limits", "Max core file size")[..2], ["0", "0"], "{process:?}");
    }
    running.signal(Signal::INT);
    running.wait().with_status(130);
    joined.wait().with_status(0);
}

#[test]
fn a_run_listens_on_no_socket_of_the_network() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    running.until_steps(&run, 500);
    for process in place.processes() {
        let root = PathBuf::from(format!("/proc/{}", process.id.as_raw_nonzero()));
        // A process that has ended since it was listed listens on no socket.
        let Ok(descriptors) = fs::read_dir(root.join("fd")) else { continue };
        let sockets: Vec<String> = descriptors
            .flatten()
            .filter_map(|entry| fs::read_link(entry.path()).ok())
            .filter_map(|target| {
                Some(target.to_str()?.strip_prefix("socket:[")?.trim_end_matches(']').to_owned())
            })
            .collect();
        for table in ["tcp", "tcp6", "udp", "udp6"] {
            let text = fs::read_to_string(root.join("net").join(table)).unwrap_or_default();
            // Column 10 is the inode.
            let inodes = text.lines().skip(1).filter_map(|line| line.split_whitespace().nth(9));
            for inode in inodes {
                assert!(!sockets.iter().any(|socket| socket == inode), "{process:?}: {table}");
            }
        }
    }
    running.signal_group(Signal::INT);
    running.wait().with_status(130);
}
