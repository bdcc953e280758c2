//! `dmprl demos`, and training from data sets of other formats, as in docs/demonstrations.md.

use std::fs;
use std::path::Path;
use std::process::Command;

use dmprl_supervisor::python_setup::{Home, ensure_extra};
use dmprl_tests::program::{Workplace, rows};
use dmprl_tests::project_root;

use crate::train;

/// Records four episodes of `panda-reach` with the example's controller. Writes them as a
/// LeRobotDataset into the folder of the second argument, and as a Minari data set.
const RECORD: &str = r#"
import json, sys
from pathlib import Path

import gymnasium, minari
import pyarrow as pa
from minari.data_collector import EpisodeBuffer
from pyarrow import parquet

sys.path.insert(0, sys.argv[1])
import record_demonstrations as demos

env = gymnasium.make(demos.TASK)
steps = demos.record(env, demos.act, 4, 0)
observations, actions = steps["observations"], steps["actions"]

folder = Path(sys.argv[2])
(folder / "meta").mkdir(parents=True)
(folder / "data/chunk-000").mkdir(parents=True)
features = {
    name: {"dtype": "float32", "shape": [rows.shape[1]], "names": None}
    for name, rows in [("observation.state", observations), ("action", actions)]
}
info = {"codebase_version": "v3.0", "fps": 25, "total_episodes": 4, "total_frames": 200}
(folder / "meta/info.json").write_text(json.dumps({**info, "features": features}))
columns = {"observation.state": observations.tolist(), "action": actions.tolist()}
columns["episode_index"] = [row // 50 for row in range(200)]
columns["frame_index"] = [row % 50 for row in range(200)]
parquet.write_table(pa.table(columns), folder / "data/chunk-000/file-000.parquet")

buffers = [
    EpisodeBuffer(
        observations=[*observations[rows], steps["next_observations"][rows][-1]],
        actions=[*actions[rows]],
        rewards=[*steps["rewards"][rows]],
        terminations=[*steps["terminated"][rows]],
        truncations=[*steps["truncated"][rows]],
        infos={},
    )
    for rows in (slice(first, first + 50) for first in range(0, 200, 50))
]
spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
minari.create_dataset_from_buffers("panda/reach-v0", buffers, **spaces)
"#;

/// Returns a place with the data sets `lerobot` and `minari:panda/reach-v0`.
fn recorded() -> Workplace {
    let place = Workplace::new();
    let home = Home::Clone(project_root().to_owned());
    let python = ensure_extra(&home, "demos", &|line| eprintln!("{line}")).unwrap().executable;
    let output = Command::new(python)
        .args(["-W", "ignore", "-c", RECORD])
        .arg(project_root().join("docs/examples"))
        .arg(place.path("lerobot"))
        .env("MINARI_DATASETS_PATH", place.path("minari"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    place
}

#[test]
fn data_sets_of_other_formats_are_shown_converted_and_trained_from() {
    let place = recorded();
    let shown = place.run(&["demos", "show", "lerobot", "--task", "panda-reach", "--json"]);
    let shown = shown.with_status(0).json();
    assert_eq!((&shown["episodes"], &shown["steps"]), (&4.into(), &196.into()), "{shown:#}");
    let missing = shown["missing"][0].as_str().unwrap();
    assert!(missing.starts_with("there are no rewards"), "{missing}");
    let convert = ["demos", "convert", "lerobot", "demos.npz", "--task", "panda-reach"];
    place.run(&convert).with_status(2).saying("--reward");
    let wrong = [&convert[..], &["--observation", "state"]].concat();
    place.run(&wrong).with_status(2).saying("there are: observation.state (20), action (3)");
    assert!(!Path::new(&place.path("demos.npz")).exists());
    place.run(&[&convert[..], &["--reward", "-0.1"]].concat()).with_status(0);
    let text = place.run(&["demos", "show", "demos.npz"]).with_status(0).printed;
    assert!(text.contains("4, 196 steps (49 each)"), "{text}");

    // One converted before, one while the run starts.
    let run = place.path("run");
    let more = ["--steps", "600", "--demos", "demos.npz", "--demos", "minari:panda/reach-v0"];
    let mut command = Command::new(dmprl_tests::program::executable());
    command.args(train("panda-reach", &run, &more));
    command.env("MINARI_DATASETS_PATH", place.path("minari"));
    let said = place.start_command(command).wait().with_status(0).said;
    assert!(said.contains("minari:panda/reach-v0: 4 episodes, 200 steps"), "{said}");
    assert!(said.contains("396 demonstrated steps in 8 episodes"), "{said}");
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(
        last["replay_segments"].as_u64().unwrap(),
        last["segments"].as_u64().unwrap() + 80,
        "50 or 49 steps are ten segments: {last}"
    );
    let converted = Path::new(&run).join("demonstrations-2.npz");
    let config = fs::read_to_string(Path::new(&run).join("config.toml")).unwrap();
    assert!(converted.is_file() && config.contains("demonstrations-2.npz"), "{config}");
    assert!(!config.contains("minari:"), "{config}");
    place.run(&["resume", &run, "--steps", "800"]).with_status(0);

    // The run's configuration needs nothing but its own files.
    fs::remove_dir_all(place.path("minari")).unwrap();
    let again = place.path("again");
    let from = Path::new(&run).join("config.toml").display().to_string();
    let arguments = ["train", "panda-reach", "--config", &from, "--run-dir", &again];
    let end = place.run(&[&arguments[..], &["--steps", "300"]].concat()).with_status(0);
    assert!(end.said.contains("396 demonstrated steps"), "{}", end.said);
    place.assert_no_process();
}

#[test]
fn a_data_set_that_cannot_be_used_leaves_no_run_and_names_the_remedy() {
    let place = Workplace::new();
    fs::create_dir(place.path("empty")).unwrap();
    place.run(&["demos", "show", "nowhere"]).with_status(2).saying("no such file or folder");
    place.run(&["demos", "show", "empty"]).with_status(2).saying("a folder without either");
    let run = place.path("run");
    for source in ["empty", "minari:nothing-v0"] {
        let mut command = Command::new(dmprl_tests::program::executable());
        command.args(train("reacher", &run, &["--demos", source]));
        command.env("MINARI_DATASETS_PATH", place.path("minari"));
        let end = place.start_command(command).wait().with_status(2).saying(source);
        end.saying(&format!("dmprl demos convert {source} demos.npz --task reacher"));
        assert!(!Path::new(&run).exists(), "{source}");
    }
    let set = "demonstrations.files=['minari:nothing-v0']";
    let arguments = ["bench", "system", "--task", "reacher", "--set", set];
    let advice = "dmprl demos convert minari:nothing-v0 demos.npz --task reacher";
    place.run(&arguments).with_status(2).saying(advice);
    place.assert_no_process();
}
