//! Compares the event file with the lines. `envs_py/tests_extras` reads it with TensorBoard.

use std::fs::OpenOptions;
use std::io::Write;

use dmprl_run::Manifest;
use dmprl_shared::config::ExperimentConfig;

use super::*;

fn new_run(parent: &tempfile::TempDir) -> RunDirectory {
    let manifest = Manifest::new(None).unwrap();
    let path = parent.path().join("run");
    RunDirectory::create(&path, &ExperimentConfig::default(), &manifest).unwrap()
}

fn add(path: &Path, text: &str) {
    let mut file = OpenOptions::new().append(true).create(true).open(path).unwrap();
    file.write_all(text.as_bytes()).unwrap();
}

/// Returns (tag, step, number) of every scalar in the only event file, in order.
fn mirrored(run: &RunDirectory) -> Vec<(String, i64, f32)> {
    let files: Vec<_> = run.path().join(FOLDER).read_dir().unwrap().flatten().collect();
    assert_eq!(files.len(), 1, "{files:?}");
    events::scalars_of(&std::fs::read(files[0].path()).unwrap())
}

#[test]
fn complete_lines_are_copied_and_an_incomplete_one_waits() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let mut writer = Writer::new(&run);
    writer.follow().unwrap();
    assert!(!run.path().join(FOLDER).exists(), "a run without a line has no event file");

    add(&run.metrics_path(), "{\"env_steps\":5,\"wall_s\":1.0,\"q_mean\":-2.5,\"a\":{\"b\":7}}\n");
    add(&run.metrics_path(), "{\"env_steps\":10,\"wall_s\":2.0,");
    add(&run.evaluations_path(), "{\"env_steps\":5,\"wall_s\":1.5,\"returns\":[1,2],\"x\":null}\n");
    writer.follow().unwrap();
    let named = |tag: &str, step, number| (tag.to_owned(), step, number);
    let mut expected = vec![
        named("training/a/b", 5, 7.0),
        named("training/q_mean", 5, -2.5),
        named("training/wall_s", 5, 1.0),
        named("evaluation/wall_s", 5, 1.5),
    ];
    assert_eq!(mirrored(&run), expected);

    add(&run.metrics_path(), "\"q_mean\":-1.0}\n");
    writer.follow().unwrap();
    writer.follow().unwrap();
    expected.extend([named("training/q_mean", 10, -1.0), named("training/wall_s", 10, 2.0)]);
    assert_eq!(mirrored(&run), expected);
}

#[test]
fn event_file_has_no_rows_that_a_resume_removed() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let line = |step: u64, number: f64| format!("{{\"env_steps\":{step},\"q_mean\":{number}}}\n");
    let expected = |rows: &[(i64, f32)]| -> Vec<_> {
        rows.iter().map(|&(step, number)| ("training/q_mean".to_owned(), step, number)).collect()
    };
    let mut writer = Writer::new(&run);
    for step in [1, 2, 3] {
        add(&run.metrics_path(), &line(step, 0.5));
    }
    writer.follow().unwrap();
    // A restarted learner rewinds to its checkpoint while the mirror is running, and the file soon
    // grows beyond its old length.
    run.rewind(1).unwrap();
    for step in [2, 3, 4] {
        add(&run.metrics_path(), &line(step, 0.25));
    }
    writer.follow().unwrap();
    assert_eq!(mirrored(&run), expected(&[(1, 0.5), (2, 0.25), (3, 0.25), (4, 0.25)]));

    // The next session starts with all existing lines.
    let mut next = Writer::new(&run);
    run.rewind(2).unwrap();
    next.follow().unwrap();
    assert_eq!(mirrored(&run), expected(&[(1, 0.5), (2, 0.25)]));
}

#[test]
fn drop_waits_until_the_last_line_is_copied() {
    let parent = tempfile::tempdir().unwrap();
    let run = new_run(&parent);
    let mirror = Mirror::start(&run);
    add(&run.metrics_path(), "{\"env_steps\":1,\"q_mean\":1.0}\n");
    drop(mirror);
    assert_eq!(mirrored(&run).len(), 1);
}
