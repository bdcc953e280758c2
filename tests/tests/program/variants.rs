//! Every policy, start and preset trains on every kind of environment.

use std::fs;
use std::path::Path;

use dmprl_tests::program::{Workplace, env_steps, rows};
use dmprl_tests::tiny_envs_dir;

use crate::train;

fn trains(task: &str, more: &[&str]) {
    let place = Workplace::new();
    let run = place.path("run");
    let more = [&["--steps", "1200"][..], more].concat();
    place.run(&train(task, &run, &more)).with_status(0);
    let evaluations = rows(&run, "evaluations.jsonl");
    assert!(env_steps(&evaluations).last() >= Some(&1200), "{evaluations:?}");
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert!(last["updates"].as_u64() > Some(0), "{last}");
    assert!(last["rejected"].as_object().unwrap().values().all(|count| count == 0), "{last}");
    assert!(place.run(&["eval", &run]).with_status(0).printed.contains("(the same)"));
    place.assert_no_process();
}

#[test]
fn the_paper_preset_trains() {
    trains("reacher", &["--preset", "paper"]);
}

#[test]
fn a_policy_that_decides_every_step_trains() {
    trains("reacher", &["--policy", "mlp"]);
    trains("reacher", &["--policy", "chunk"]);
}

#[test]
fn a_dmp_that_starts_where_the_joints_are_trains() {
    trains("reacher", &["--set", "policy.start=observed"]);
}

#[test]
fn a_dmp_that_carries_its_state_on_trains() {
    let carry = ["--set", "policy.start=carry", "--set", "exploration.warm_up_kind=dmp_parameters"];
    trains("reacher", &carry);
}

#[test]
fn segments_that_start_at_the_last_action_train() {
    let action = ["--set", "policy.start=action", "--set", "policy.controller=direct"];
    trains("pusher", &action);
    trains("panda-push", &action);
    trains("reacher", &["--policy", "chunk", "--set", "policy.start=action"]);
}

/// On-policy: the number of its segments is not bounded, and some are stale.
#[test]
fn neural_dynamic_policies_train() {
    let ndp = |more: &[&'static str]| {
        [&["--algo", "ndp", "--set", "exploration.warm_up_steps=0"], more].concat()
    };
    trains("reacher", &ndp(&["--workers", "1"]));
    trains("panda-reach", &ndp(&["--preset", "paper"]));
    trains("pusher", &ndp(&["--set", "policy.controller=inverse"]));
    let action = ["--set", "policy.start=action", "--set", "policy.controller=direct"];
    trains("reacher", &ndp(&action));
}

/// Updates as graphs: of an algorithm with kernels, and of one without.
#[test]
fn algorithms_train_as_graphs() {
    trains("reacher", &["--backend", "graph"]);
    trains("reacher", &["--algo", "tqc"]);
    trains("panda-push", &["--algo", "tqc", "--policy", "mlp"]);
}

#[test]
fn the_seven_joints_of_pusher_train() {
    trains("pusher", &[]);
}

#[test]
fn thrower_trains() {
    trains("thrower", &[]);
}

#[test]
fn both_panda_tasks_train_from_where_the_robot_is() {
    trains("panda-reach", &["--set", "policy.start=observed"]);
    trains("panda-reach-joints", &["--set", "policy.start=observed"]);
}

#[test]
fn the_papers_older_versions_train() {
    trains("reacher-v1", &["--preset", "paper"]);
    trains("pusher-v0", &[]);
}

#[test]
fn any_gymnasium_id_trains() {
    trains("Pendulum-v1", &[]);
}

/// Its episodes terminate at the third of the five steps of a segment.
#[test]
fn an_environment_of_ones_own_that_ends_inside_a_segment_trains() {
    let folder = tiny_envs_dir();
    trains("tiny_envs:Countdown-v0", &["--python-path", folder.to_str().unwrap()]);
}

/// Episodes of seven steps: the time limit cuts every second segment short.
#[test]
fn an_environment_with_a_time_limit_inside_a_segment_trains() {
    let folder = tiny_envs_dir();
    trains("tiny_envs:Long-v0", &["--python-path", folder.to_str().unwrap()]);
}

#[test]
fn an_environment_whose_observation_is_a_dictionary_trains() {
    let folder = tiny_envs_dir();
    trains("tiny_envs:Goal-v0", &["--python-path", folder.to_str().unwrap()]);
}

/// Its two actions have different, asymmetric bounds.
#[test]
fn a_class_that_nobody_registered_trains() {
    let folder = tiny_envs_dir();
    trains("tiny_envs:Limited", &["--python-path", folder.to_str().unwrap()]);
}

#[test]
fn a_segment_env_of_ones_own_trains() {
    let folder = tiny_envs_dir();
    trains("tiny_envs:Timed", &["--python-path", folder.to_str().unwrap()]);
}

#[test]
fn a_goal_trains_with_hindsight_in_several_processes_and_in_one() {
    let path = tiny_envs_dir();
    let hindsight = ["--set", "replay.hindsight=future", "--python-path", path.to_str().unwrap()];
    for (task, more) in [
        ("ReachUndeclared", &[][..]),
        ("ReachUndeclared", &["--deterministic"]),
        ("Reach", &[]),
        ("Reach", &["--deterministic"]),
    ] {
        let place = Workplace::new();
        let run = place.path("run");
        let more = [&["--steps", "1200"], &hindsight[..], more].concat();
        place.run(&train(&format!("tiny_envs:{task}-v0"), &run, &more)).with_status(0);
        let last = rows(&run, "metrics.jsonl").pop().unwrap();
        let count = |key: &str| last[key].as_u64().unwrap();
        let spec = fs::read_to_string(Path::new(&run).join("spec.json")).unwrap();
        assert_eq!(spec.contains("goal_rule"), task == "Reach", "{spec}");
        // Episodes of twelve steps are three segments with four copies each, unless the learner
        // draws goals by the environment's rule.
        match task {
            "Reach" => assert_eq!(count("hindsight_segments"), 0, "{last}"),
            _ => assert!(count("hindsight_segments") >= 12 * (1200 / 12 - 16), "{last}"),
        }
        assert!(count("env_steps") <= 1300 && count("segments") <= 400, "{last}");
        assert_eq!((count("lost"), last["rejected"]["duplicate"].as_u64()), (0, Some(0)));
        assert!(last["rejected"].as_object().unwrap().values().all(|count| count == 0), "{last}");
        place.assert_no_process();
    }
}

#[test]
fn hindsight_is_recommended_for_a_sparse_goal_and_refused_where_there_is_none() {
    let path = tiny_envs_dir();
    let path = ["--steps", "300", "--python-path", path.to_str().unwrap()];
    for (task, recommended) in [("tiny_envs:Reach-v0", true), ("tiny_envs:ReachFar-v0", false)] {
        let place = Workplace::new();
        let end = place.run(&train(task, &place.path("run"), &path)).with_status(0);
        assert_eq!(end.said.contains("replay.hindsight=future"), recommended, "{task}");
    }
    let place = Workplace::new();
    let more = [&path[..], &["--set", "replay.hindsight=future"]].concat();
    let end = place.run(&train("tiny_envs:Long-v0", &place.path("run"), &more)).with_status(1);
    assert!(end.said.contains("its observation is not a Dict"), "{}", end.said);
    place.assert_no_process();
}

/// As in docs/demonstrations.md, with its script.
#[test]
fn a_run_starts_from_demonstrations_and_keeps_them_through_a_resume() {
    let place = Workplace::new();
    let (run, file) = (place.path("run"), place.path("demos.npz"));
    let script = dmprl_tests::project_root().join("docs/examples/record_demonstrations.py");
    let python = dmprl_tests::venv().venv.join("bin/python");
    let recorded = std::process::Command::new(python).arg(script).arg(&file).output().unwrap();
    assert!(recorded.status.success(), "{recorded:?}");
    let end = place.run(&train("panda-reach", &run, &["--steps", "1200", "--demos", &file]));
    let told = end.with_status(0).said;
    assert!(told.contains("1000 demonstrated steps in 20 episodes, return -0.19"), "{told}");
    // An untrained policy gets about -15 on these seeds, this one -5.1.
    let reached = rows(&run, "evaluations.jsonl").pop().unwrap()["return_mean"].as_f64().unwrap();
    assert!(reached > -9.0, "{reached}");
    std::fs::remove_file(&file).unwrap();
    place.run(&["resume", &run, "--steps", "1600"]).with_status(0);
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    let count = |key: &str| last[key].as_u64().unwrap();
    // Episodes of fifty steps are ten segments each.
    assert_eq!(count("replay_segments"), count("segments") + 200, "{last}");
    assert!(count("env_steps") >= 1600 && count("updates") > 0, "{last}");
    place.assert_no_process();
}
