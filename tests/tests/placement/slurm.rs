//! Runs `deploy/slurm/train.sbatch` completely, with `srun`, `scontrol` and `dmprl` replaced by a
//! few lines of bash that record their calls.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use dmprl_tests::program::until;
use dmprl_tests::project_root;
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use tempfile::TempDir;

/// The learner of a run waits until the test writes its exit status to `over`; so do the bridges,
/// which exit with 0. Both end when the run's directory is removed, so a failed test leaves
/// nothing.
const DMPRL: &str = r#"
echo "dmprl $*" >>"$CALLS"
case $1 in
    train) run=$(sed 's/.*--run-dir \([^ ]*\).*/\1/' <<<"$*") ;;
    resume) run=$2 ;;
    bridge) run=$(sed 's/.*--token-file \(.*\)\/bridge.token.*/\1/' <<<"$*") ;;
esac
if [ "$1" = train ]; then
    mkdir -p "$run"
    echo "listen = $(sed 's/.*bridge.listen=\([^ ]*\).*/\1/' <<<"$*")" >"$run/config.toml"
    echo '{}' >"$run/manifest.json"
    echo secret >"$run/bridge.token"
fi
[ "$1" = bridge ] || trap 'echo "stopped" >>"$CALLS"; echo 0 >"$run/over"; exit 130' TERM
until [ -e "$run/over" ] || [ ! -d "$run" ]; do sleep 0.02; done
[ "$1" = bridge ] || exit "$(cat "$run/over")"
"#;
const SRUN: &str = r#"
echo "srun $*" >>"$CALLS"
while [[ $1 == --* ]]; do shift; done
exec "$@"
"#;
const SCONTROL: &str = r#"
if [ "$1" = show ]; then printf '%s\n' first second third; else echo "scontrol $*" >>"$CALLS"; fi
"#;

struct Job {
    folder: TempDir,
}

impl Job {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in [("dmprl", DMPRL), ("srun", SRUN), ("scontrol", SCONTROL)] {
            let path = folder.path().join(name);
            fs::write(&path, format!("#!/bin/bash\n{text}")).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        }
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Starts it as Slurm does on the first of three nodes with eight cores each.
    fn start(&self, arguments: &[&str]) -> Child {
        self.start_as("7", arguments)
    }

    fn start_as(&self, job: &str, arguments: &[&str]) -> Child {
        let path = std::env::var("PATH").unwrap();
        Command::new("bash")
            .arg(project_root().join("deploy/slurm/train.sbatch"))
            .args(arguments)
            .current_dir(self.folder.path())
            .env("PATH", format!("{}:{path}", self.folder.path().display()))
            .env("CALLS", self.path("calls"))
            .env("RUN_DIR", "runs/slurm-7")
            .envs([("SLURM_JOB_ID", job), ("SLURM_JOB_NODELIST", "node[1-3]")])
            .envs([("SLURM_JOB_NUM_NODES", "3"), ("SLURM_CPUS_PER_TASK", "8")])
            .env("TMPDIR", "/tmp")
            // The signal of Slurm when it ends a job.
            .process_group(0)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    }

    fn calls(&self) -> Vec<String> {
        let text = fs::read_to_string(self.path("calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    fn until_called(&self, count: usize) {
        until("calls", || self.calls().len() >= count);
    }

    fn learner_ends(&self, status: &str) {
        // Renamed, so that a reader never sees a partial file.
        fs::write(self.path("over"), status).unwrap();
        fs::rename(self.path("over"), self.path("runs/slurm-7/over")).unwrap();
    }
}

#[test]
fn learner_is_on_the_first_node_and_workers_are_on_the_others() {
    let job = Job::new();
    let mut script = job.start(&["reacher", "--steps", "5"]);
    job.until_called(3);
    job.learner_ends("0");
    assert_eq!(script.wait().unwrap().code(), Some(0));
    let bridge = "dmprl bridge --connect tls/first:10007 --token-file runs/slurm-7/bridge.token \
                  --workers 8 --run-dir /tmp/dmprl-7-0";
    let calls = job.calls();
    assert_eq!(
        calls[0],
        "dmprl train reacher --steps 5 --run-dir runs/slurm-7 --workers 1 --no-progress \
         --set bridge.listen=[\"tls/0.0.0.0:10007\"] --set bridge.workers_max=16"
    );
    assert!(calls[1].starts_with("srun --relative=1 --nodes=2 --ntasks=2 "), "{}", calls[1]);
    assert!(calls[1].ends_with(bridge), "{}", calls[1]);
    assert_eq!(calls[2..], [bridge]);
}

#[test]
fn job_whose_time_is_over_is_stopped_requeued_and_resumed() {
    let job = Job::new();
    let mut script = job.start(&["reacher"]);
    job.until_called(3);
    kill_process(Pid::from_child(&script), Signal::USR1).unwrap();
    assert_eq!(script.wait().unwrap().code(), Some(130));
    assert_eq!(job.calls()[3..], ["stopped", "scontrol requeue 7"]);

    fs::remove_file(job.path("runs/slurm-7/over")).unwrap();
    fs::remove_file(job.path("calls")).unwrap();
    let mut script = job.start_as("123456", &["reacher"]);
    job.until_called(3);
    job.learner_ends("0");
    assert_eq!(script.wait().unwrap().code(), Some(0));
    let keeps_its_port = |call: &String| call.contains("dmprl bridge --connect tls/first:10007 ");
    assert!(job.calls().iter().any(keeps_its_port), "{:?}", job.calls());
    // The token already exists, so the hosts may start first.
    assert!(job.calls().contains(&"dmprl resume runs/slurm-7 --no-progress".to_owned()));
}

#[test]
fn job_that_is_cancelled_stops_its_learner_once_and_is_not_requeued() {
    let job = Job::new();
    let mut script = job.start(&["reacher"]);
    job.until_called(3);
    // Slurm signals all processes of a job, and a second signal would cost the checkpoint.
    kill_process_group(Pid::from_child(&script), Signal::TERM).unwrap();
    assert_eq!(script.wait().unwrap().code(), Some(130));
    assert_eq!(job.calls()[3..], ["stopped"]);
}

#[test]
fn failed_learner_ends_the_job_with_its_status() {
    let job = Job::new();
    let mut script = job.start(&["reacher"]);
    job.until_called(3);
    job.learner_ends("1");
    assert_eq!(script.wait().unwrap().code(), Some(1));
    assert_eq!(job.calls().len(), 3, "nothing is requeued: {:?}", job.calls());
}

#[test]
fn nothing_is_started_without_a_task() {
    let job = Job::new();
    assert_eq!(job.start(&[]).wait().unwrap().code(), Some(2));
    assert!(job.calls().is_empty());
}
