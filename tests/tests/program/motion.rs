//! Measures the motion of trained policies with real observer processes.

use std::path::Path;

use dmprl_analysis::motion;
use dmprl_run::RunDirectory;
use dmprl_sweep::record::{Observer, measure_motion};
use dmprl_tests::program::{Workplace, executable, rows};
use dmprl_tests::venv;

use crate::train;

fn observer() -> Observer {
    Observer { program: executable().to_owned(), venv: venv().venv.clone() }
}

fn measured(run: &str) -> motion::Motion {
    let run = RunDirectory::open(Path::new(run)).unwrap();
    measure_motion(&run, &observer()).unwrap().expect("no interrupt")
}

/// The recorded episodes are those of the evaluation, so a report shows motion and return of the
/// same policy.
#[test]
fn the_episodes_measured_are_those_evaluated_also_where_the_controls_follow_the_state() {
    let place = Workplace::new();
    for (task, joints, dims) in [("reacher", 2, 2), ("panda-reach", 7, 3)] {
        let run = place.path(task);
        place.run(&train(task, &run, &["--steps", "1000"])).with_status(0);
        let motion = measured(&run);
        let row = rows(&run, "evaluations.jsonl").pop().unwrap();
        let stored: Vec<f64> = row["returns"]
            .as_array()
            .unwrap()
            .iter()
            .map(|value| value.as_f64().unwrap())
            .collect();
        assert_eq!(motion.returns.len(), stored.len());
        for (got, stored) in motion.returns.iter().zip(&stored) {
            assert!((got - stored).abs() < 1e-9, "{task}: {got}, evaluated {stored}");
        }
        let smoothness = row["smoothness"].as_f64().unwrap();
        assert!((motion.action_change.unwrap() - smoothness).abs() < 1e-6, "{task}: {smoothness}");
        assert_eq!(motion.policy_version, row["policy_version"]);
        assert_eq!(motion.env_steps, row["env_steps"]);

        let episode = &motion.episode;
        assert_eq!(motion.robot.joints.len(), joints, "{:?}", motion.robot);
        assert_eq!((episode.rewards.len(), episode.actions[0].len()), (50, dims));
        assert_eq!(episode.joint_positions.len(), 51);
        assert!(motion.joint_jerk.unwrap() > 0.0);
        assert!(motion.sparc.unwrap() < -1.0, "{:?}", motion.sparc);
    }
    place.assert_no_process();
}

#[test]
fn a_policy_is_measured_once_and_the_next_one_again() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    let directory = RunDirectory::open(Path::new(&run)).unwrap();
    assert_eq!(motion::read(&directory).unwrap(), None);
    let first = measured(&run);
    let written = || std::fs::metadata(directory.motion_path()).unwrap().modified().unwrap();
    let before = written();
    assert_eq!(measured(&run), first);
    assert_eq!(written(), before);

    place.run(&["resume", &run, "--steps", "2000"]).with_status(0);
    assert_eq!(motion::read(&directory).unwrap(), None, "the resumed run has a newer policy");
    assert_eq!(measured(&run).env_steps, 2000);
    // A damaged file is replaced.
    std::fs::write(directory.motion_path(), "{").unwrap();
    assert_eq!(measured(&run).env_steps, 2000);
}

#[test]
fn an_environment_without_joints_is_measured_by_its_actions() {
    let place = Workplace::new();
    let run = place.path("run");
    let folder = dmprl_tests::project_root().join("docs/examples");
    let folder = folder.to_str().unwrap();
    let more = ["--steps", "1000", "--python-path", folder];
    place.run(&train("point_reach:PointReach-v0", &run, &more)).with_status(0);
    let motion = measured(&run);
    assert_eq!((motion.joint_jerk, motion.sparc), (None, None));
    assert!(motion.action_change.is_some());
    assert!(motion.robot.why_no_joints.contains("not a MuJoCo environment"), "{:?}", motion.robot);
}
