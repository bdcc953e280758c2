//! `dmprl push` and `dmprl pull`, against a stand-in for the Hugging Face hub on this machine.
//! `envs_py/tests_extras/test_hub.py` tests the transfer itself.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use dmprl_shared::policy::Hold;
use dmprl_shared::policy_file;
use dmprl_tests::program::{Finished, Workplace, executable, rows};
use dmprl_tests::{project_root, venv};

use crate::train;

/// Token with write access to the namespace `me`.
const WRITER: &str = "hf_writer";

/// Runs a program beside the stand-in, whose repositories are in the folder `hub`.
fn beside_hub(place: &Workplace, token: &str, words: &[&str]) -> Finished {
    let mut command = Command::new(&venv().executable);
    command.arg(project_root().join("envs_py/tests_extras/hub_stand_in.py"));
    command.args(["--root", "hub", "--token", token, "--around"]).args(words);
    place.start_command(command).wait()
}

fn dmprl(place: &Workplace, words: &[&str]) -> Finished {
    beside_hub(place, WRITER, &[&[executable().to_str().unwrap()], words].concat())
}

/// Returns the folder of a repository's commit.
fn committed(place: &Workplace, repository: &str, commit: &str) -> PathBuf {
    place.folder().join("hub").join(repository).join(commit)
}

#[test]
fn a_pushed_policy_is_pulled_evaluated_and_trained_from() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "2500"])).with_status(0);
    let best = place.run(&["export", &run, "--json"]).with_status(0).json();
    let version = &best["policy_version"];
    for name in ["seed-1000", "seeds-1000-1002", "beside-other-policy-1-seed-7"] {
        fs::write(place.path(&format!("run/videos/policy-{version}-{name}.mp4")), name).unwrap();
    }

    let push = ["push", "run", "me/reacher", "--hold", "zero-torque", "--json"];
    let pushed = dmprl(&place, &push).with_status(0).json();
    assert_eq!(pushed["policy_version"], *version);
    assert!(pushed["url"].as_str().unwrap().ends_with("/me/reacher"), "{pushed}");
    let commit = pushed["commit"].as_str().unwrap();
    let folder = committed(&place, "me/reacher", commit);
    assert_eq!(fs::read_to_string(folder.join("replay.mp4")).unwrap(), "seeds-1000-1002");
    let card = fs::read_to_string(folder.join("README.md")).unwrap();
    assert!(card.contains("TD3 policy for reacher") && card.contains("replay.mp4"), "{card}");
    for file in ["README.md", "config.toml", "manifest.json"] {
        let text = fs::read_to_string(folder.join(file)).unwrap();
        assert!(!text.contains(place.folder().to_str().unwrap()), "{file}: {text}");
    }
    let mut evaluations = rows(folder.to_str().unwrap(), "evaluations.jsonl");
    assert!(evaluations.len() > 1);
    evaluations.retain(|row| row["returns"] != serde_json::json!([]));
    assert_eq!((evaluations.len(), &evaluations[0]["policy_version"]), (1, version));

    // A run directory, which the other commands take.
    let pulled = dmprl(&place, &["pull", "me/reacher", "--json"]).with_status(0).json();
    assert_eq!((&pulled["path"], &pulled["commit"]), (&"runs/me-reacher".into(), &commit.into()));
    let evaluated = place.run(&["eval", "runs/me-reacher", "--json"]).with_status(0).json();
    let before = place.run(&["eval", &run, "--json"]).with_status(0).json();
    assert_eq!(evaluated["returns"], before["returns"]);
    let reason = format!("is a copy of hub:me/reacher@{commit} and has no checkpoint");
    place.run(&["resume", "runs/me-reacher"]).with_status(2).saying(&reason);
    let warm = ["--steps", "600", "--init-from", "runs/me-reacher"];
    place.run(&train("reacher", &place.path("warm"), &warm)).with_status(0);
    dmprl(&place, &["pull", "me/reacher"]).with_status(0);
    let export = ["export", "runs/me-reacher", "--json"];
    let exported = dmprl(&place, &export).with_status(0).json();
    assert_eq!(exported["hold"], "zero-torque", "the hold of the uploaded file");

    // Only the policy, byte for byte.
    let file = ["pull", "me/reacher", "--revision", commit, "--output", "policy.safetensors"];
    dmprl(&place, &file).with_status(0);
    let bytes = fs::read(place.path("policy.safetensors")).unwrap();
    assert_eq!(bytes, fs::read(folder.join("policy.safetensors")).unwrap());
    let opened = policy_file::open(Path::new(&place.path("policy.safetensors"))).unwrap();
    assert_eq!(opened.hold, Some(Hold::ZeroTorque));
    assert_eq!(opened.origin.unwrap().task, "reacher");
    place.until_no_process();
}

#[test]
fn a_policy_for_a_task_of_ones_own_is_pulled_with_its_folder() {
    let place = Workplace::new();
    let (run, modules) = (place.path("run"), project_root().join("docs/examples"));
    let modules = modules.to_str().unwrap();
    let more = ["--steps", "1000", "--python-path", modules];
    place.run(&train("point_reach:PointReach-v0", &run, &more)).with_status(0);
    let push = ["push", "run", "me/point", "--film", "film.gif", "--message", "Reach"];
    dmprl(&place, &push).with_status(2).saying("film.gif: expected an existing .mp4 or .gif");
    fs::write(place.path("film.gif"), "GIF").unwrap();
    let printed = dmprl(&place, &push).with_status(0).printed;
    assert!(printed.contains("download it: dmprl pull me/point"), "{printed}");

    dmprl(&place, &["pull", "me/point", "--python-path", modules]).with_status(0);
    let config = fs::read_to_string(place.path("runs/me-point/config.toml")).unwrap();
    assert!(config.contains(modules), "{config}");
    let eval = ["eval", "runs/me-point", "--episodes", "1"];
    place.run(&eval).with_status(2).saying("module point_reach");
    place.run(&[&eval[..], &["--trust-code"]].concat()).with_status(0);
}

#[test]
fn python_pushes_and_pulls_and_nothing_is_replaced() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1500"])).with_status(0);
    let script = format!(
        "import sys; sys.path.insert(0, {:?})
from dmprl import Run, program, pull
from pathlib import Path
program.find = lambda: Path({:?})
print(Run('run').push('me/reacher', private=True))
print(pull('me/reacher', output='pulled').policy())",
        project_root().join("envs_py"),
        executable()
    );
    let python = venv().executable.to_str().unwrap().to_owned();
    let printed = beside_hub(&place, WRITER, &[&python, "-c", &script]).with_status(0).printed;
    assert!(printed.contains("/me/reacher") && printed.contains("Policy"), "{printed}");

    let before = fs::read(place.path("run/config.toml")).unwrap();
    for (output, words) in [("run", "run exists and is no copy of a policy"), ("pulled", "")] {
        let expected = if words.is_empty() { 0 } else { 2 };
        let pull = ["pull", "me/reacher", "--output", output];
        dmprl(&place, &pull).with_status(expected).saying(words);
    }
    dmprl(&place, &["push", "run", "me/reacher", "--policy", "latest", "--message", "Newer"])
        .with_status(0);
    let newer = dmprl(&place, &["pull", "me/reacher", "--output", "pulled"]).with_status(2);
    newer.saying("pulled exists and is a copy of hub:me/reacher@");
    assert_eq!(fs::read(place.path("run/config.toml")).unwrap(), before);
}

#[test]
fn a_policy_that_cannot_be_shared_says_why() {
    let place = Workplace::new();
    let push = ["push", "zoo:panda-reach", "me/reach"];
    let words = [&[executable().to_str().unwrap()], &push[..]].concat();
    beside_hub(&place, "", &words).with_status(2).saying("expected one with write access");
    dmprl(&place, &["push", "zoo:panda-reach", "reach"]).with_status(2).saying("OWNER/NAME");
    let still = [&push[..], &["--hold", "position=0"]].concat();
    dmprl(&place, &still).with_status(2).saying("has 1 values, expected 3");
    dmprl(&place, &["pull", "me/reach"]).with_status(2).saying("there is no repository");

    let pushed = dmprl(&place, &[&push[..], &["--json"]].concat()).with_status(0).json();
    let folder = committed(&place, "me/reach", pushed["commit"].as_str().unwrap());
    let policy = folder.join("policy.safetensors");
    let mut bytes = fs::read(&policy).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&policy, bytes).unwrap();
    dmprl(&place, &["pull", "me/reach"]).with_status(1).saying("checksum is");
    assert!(!Path::new(&place.path("runs/me-reach")).exists());
}
