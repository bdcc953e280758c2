//! Runs `deploy/slurm/sweep.sbatch` completely. Its commands and `scontrol` record their calls.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::{Child, Command, Stdio};

use dmprl_tests::program::until;
use dmprl_tests::project_root;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

const SCONTROL: &str = "#!/bin/bash\necho \"scontrol $*\" >>\"$CALLS\"\n";
/// A run that stops on SIGTERM, or when its folder is removed.
const RUN: &str = r#"#!/bin/bash
trap 'echo stopped >>"$CALLS"; exit 130' TERM
echo started >>"$CALLS"
while [ -e "$CALLS" ]; do sleep 0.02; done
"#;

struct Array {
    folder: TempDir,
}

impl Array {
    fn new(commands: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in [("scontrol", SCONTROL), ("run", RUN)] {
            let path = folder.path().join(name);
            fs::write(&path, text).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        }
        fs::write(folder.path().join("runs.txt"), commands.join("\n")).unwrap();
        Self { folder }
    }

    /// Starts the task as Slurm does.
    fn start(&self, task: u32) -> Child {
        let path = std::env::var("PATH").unwrap();
        Command::new("bash")
            .arg(project_root().join("deploy/slurm/sweep.sbatch"))
            .arg("runs.txt")
            .current_dir(self.folder.path())
            .env("PATH", format!("{}:{path}", self.folder.path().display()))
            .env("CALLS", self.folder.path().join("calls"))
            .env("SLURM_ARRAY_JOB_ID", "7")
            .env("SLURM_ARRAY_TASK_ID", task.to_string())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    }

    fn calls(&self) -> Vec<String> {
        let text = fs::read_to_string(self.folder.path().join("calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }
}

#[test]
fn each_task_runs_its_line_and_ends_with_its_status() {
    let array = Array::new(&["echo first >>$CALLS", "echo 'second one' >>$CALLS; exit 3"]);
    assert_eq!(array.start(2).wait().unwrap().code(), Some(3));
    assert_eq!(array.calls(), ["second one"]);
    assert_eq!(array.start(3).wait().unwrap().code(), Some(2), "there is no such line");
}

#[test]
fn task_whose_time_is_over_is_stopped_and_requeued() {
    let array = Array::new(&["if true; then run; else false; fi"]);
    let mut script = array.start(1);
    until("the run", || array.calls() == ["started"]);
    kill_process(Pid::from_child(&script), Signal::USR1).unwrap();
    assert_eq!(script.wait().unwrap().code(), Some(130));
    assert_eq!(array.calls(), ["started", "stopped", "scontrol requeue 7_1"]);
}
