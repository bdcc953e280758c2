//! `dmprl record`: videos and logs of real runs, checked with the libraries that made them.

use std::fs;
use std::path::Path;
use std::process::Command;

use dmprl_tests::program::{Workplace, executable};
use dmprl_tests::skipped::skipped;
use dmprl_tests::venv;
use rustix::process::Signal;
use serde_json::Value;

use crate::train;

/// Prints frames, width and height of a video, and the number of frames of an animation.
const LOOK: &str = "
import sys, av
from PIL import Image
video = av.open(sys.argv[1])
frames = [frame.to_image() for frame in video.decode(video=0)]
differing = sum(a.tobytes() != b.tobytes() for a, b in zip(frames, frames[1:]))
gif = Image.open(sys.argv[2])
strip = Image.open(sys.argv[3])
print(len(frames), *frames[0].size, differing, gif.n_frames, *strip.size)
";

/// Prints the rows of each entity of a Rerun log that changes over time.
const READ_LOG: &str = "
import collections, json, sys
from rerun.chunk import RrdReader
rows = collections.Counter()
for chunk in RrdReader(sys.argv[1]).stream().to_chunks():
    if not chunk.is_static:
        rows[chunk.entity_path] += chunk.num_rows
print(json.dumps(rows))
";

fn python(arguments: &[&str]) -> std::process::Output {
    Command::new(&venv().executable).arg("-I").args(arguments).output().unwrap()
}

/// Returns true if this machine can draw; otherwise the caller skips its check of pictures.
pub(super) fn can_draw() -> bool {
    let asked = "import os; from dmprl.pictures import name_opengl; name_opengl(); \
                 raise SystemExit('MUJOCO_GL' not in os.environ)";
    let can = python(&["-c", asked]).status.success();
    if !can {
        let what = "videos and live pictures, which OpenGL draws";
        skipped("TEST_OPENGL_REQUIRED", what, "apt install libegl1 libgl1-mesa-dri");
    }
    can
}

fn numbers(text: &[u8]) -> Vec<u64> {
    String::from_utf8_lossy(text).split_whitespace().map(|word| word.parse().unwrap()).collect()
}

fn returns(values: &Value) -> Vec<f64> {
    values.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
}

/// Trains two policies, `dmp` and `mlp`; returns the paths of their runs.
fn two_runs(place: &Workplace) -> [String; 2] {
    ["dmp", "mlp"].map(|policy| {
        let run = place.path(policy);
        place.run(&train("reacher", &run, &["--steps", "1000", "--policy", policy])).with_status(0);
        run
    })
}

#[test]
fn two_runs_side_by_side_show_the_episodes_that_eval_runs() {
    let place = Workplace::new();
    let [run, other] = two_runs(&place);
    if !can_draw() {
        return;
    }
    let arguments = ["record", &run, "--compare", &other, "--episodes", "2", "--json"];
    let made = place.run(&arguments).with_status(0).json();
    for (side, path) in [&run, &other].into_iter().enumerate() {
        let evaluated = place.run(&["eval", path, "--json"]).with_status(0).json();
        for (index, expected) in returns(&evaluated["returns"]).iter().take(2).enumerate() {
            let episode = &made["sides"][side]["episodes"][index];
            assert_eq!(episode["seed"], 1000 + index);
            assert_eq!((&episode["steps"], &episode["frames"]), (&50.into(), &51.into()));
            let got = episode["return"].as_f64().unwrap();
            assert!((got - expected).abs() < 1e-9, "{got}, evaluated {expected}");
        }
    }
    let file = |key: &str| made[key].as_str().unwrap().to_owned();
    let files = [file("mp4"), file("gif"), file("strip")];
    assert!(files.iter().all(|file| file.starts_with(&format!("{run}/videos/"))), "{files:?}");
    let [mp4, gif, strip] = &files;
    let looked = python(&["-c", LOOK, mp4, gif, strip]);
    assert!(looked.status.success(), "{}", String::from_utf8_lossy(&looked.stderr));
    // Two scenes of 480 pixels and the gap between them; 50 frames per second become 25 in the GIF.
    let expected = [102, 968, 568, 101, 51, 6 * 240 + 5 * 8, 4 * (240 + 2 * 44)];
    assert_eq!(numbers(&looked.stdout), expected);
    assert_eq!(fs::read_dir(format!("{run}/videos")).unwrap().count(), 3, "nothing else is left");
    place.assert_no_process();
}

#[test]
fn a_rerun_log_of_two_runs_is_written_beside_the_video() {
    let place = Workplace::new();
    let [run, other] = two_runs(&place);
    if !can_draw() {
        return;
    }
    let arguments = ["record", &run, "--compare", &other, "--rerun", "--json"];
    let made = place.run(&arguments).with_status(0).json();
    let log = made["rrd"].as_str().unwrap();
    assert_eq!(log, made["mp4"].as_str().unwrap().replace(".mp4", ".rrd"));
    assert_eq!(fs::read_dir(format!("{run}/videos")).unwrap().count(), 4, "nothing else is left");
    let read = python(&["-c", READ_LOG, log]);
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
    let rows: Value = serde_json::from_slice(&read.stdout).unwrap();
    for side in ["dmp", "mlp"] {
        for (entity, expected) in [("camera", 51), ("command/action\\[1\\]", 50), ("return", 51)] {
            let path = format!("/{side}/episode_1000/{entity}");
            assert_eq!(rows[&path], expected, "{path}: {rows}");
        }
    }
    // Both decide at every step.
    assert_eq!(rows["/dmp/episode_1000/segment/goal/action\\[0\\]"], 50, "{rows}");
    assert_eq!(rows["/mlp/episode_1000/segment/index"], 50, "{rows}");
    place.assert_no_process();
}

#[test]
fn what_cannot_be_recorded_is_said() {
    let place = Workplace::new();
    let (run, other, own) = (place.path("run"), place.path("other"), place.path("own"));
    place.run(&["record", "nowhere"]).with_status(2).saying("no run directory nowhere");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    place.run(&train("reacher-v1", &other, &["--steps", "1000"])).with_status(0);
    place
        .run(&["record", &run, "--compare", &other])
        .with_status(2)
        .saying("episodes of the same seed would differ");
    let mut without_opengl = Command::new(executable());
    without_opengl.args(["record", &run]).env("MUJOCO_GL", "osmosis");
    place
        .start_command(without_opengl)
        .wait()
        .with_status(1)
        .saying("no OpenGL to draw with (MUJOCO_GL=osmosis")
        .saying("apt install libegl1");
    let folder = dmprl_tests::project_root().join("docs/examples");
    let more = ["--steps", "1000", "--python-path", folder.to_str().unwrap()];
    place.run(&train("point_reach:PointReach-v0", &own, &more)).with_status(0);
    place
        .run(&["record", &own])
        .with_status(1)
        .saying("cannot be drawn")
        .saying("expected a Gymnasium environment with the render mode 'rgb_array'");
    assert_eq!(fs::read_dir(format!("{own}/videos")).unwrap().count(), 0);
    place.assert_no_process();
}

#[test]
fn an_interrupted_recording_leaves_nothing() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    if !can_draw() {
        return;
    }
    let mut recording = place.start(&["record", &run, "--episodes", "100"]);
    let videos = Path::new(&run).join("videos");
    let drawn = || {
        let workshops = fs::read_dir(&videos).into_iter().flatten().flatten();
        let pictures = workshops.map(|entry| entry.path().join("0/pictures"));
        pictures.filter_map(|folder| fs::read_dir(folder).ok()).any(|it| it.count() > 0)
    };
    recording.until("a frame", |_| drawn());
    recording.signal_group(Signal::INT);
    recording.wait().with_status(130);
    place.assert_no_process();
    assert_eq!(fs::read_dir(&videos).unwrap().count(), 0, "half a recording was left");
}
