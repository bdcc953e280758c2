//! Wrong use ends with status 2 and the right name, and writes no file.

use std::fs;

use dmprl_tests::program::Workplace;

#[test]
fn wrong_use_names_the_right_word_and_creates_nothing() {
    let place = Workplace::new();
    for (arguments, expected) in [
        (&["train", "reachr"][..], "did you mean `reacher`"),
        (&["train", "reacher", "--stps", "5"], "--steps"),
        (&["train", "reacher", "--preset", "papr"], "paper"),
        (&["train", "reacher", "--set", "algorithm.bach_size=3"], "algorithm.batch_size"),
        (&["train", "reacher", "--set", "policy.start=carry"], "warm_up_kind"),
        (&["train", "reacher", "--algo", "ndp", "--policy", "mlp"], "movement primitives"),
        (&["train", "Pendulum-v1", "--algo", "ndp"], "start_sources"),
        (&["train", "reacher", "--set", "novalue"], "KEY=VALUE"),
        (&["train", "reacher", "--env-kwargs", "novalue"], "KEY=VALUE"),
        (&["train", "reacher", "--env-kwargs", "dense=False"], "such as false"),
        (&["train", "reacher", "--set", "task.wrappers=['slow']"], "module:function"),
        (&["train", "reacher", "--steps", "0"], "run.steps"),
        (&["train", "reacher", "--init-from", "nowhere"], "nowhere"),
        (&["train", "reacher", "--python-path", "nowhere"], "nowhere"),
        (&["train", "reacher", "--demos", "nowhere.npz"], "nowhere.npz"),
        (&["train", "reacher", "--run-dir", "out/.."], "needs a name"),
        (&["resume", "nowhere"], "nowhere"),
        (&["eval", "nowhere"], "nowhere"),
    ] {
        let finished = place.run(arguments).with_status(2).saying(expected);
        assert!(finished.said.starts_with("error: "), "{}", finished.said);
        // The harness has removed the folder for the output already.
        let files: Vec<_> = fs::read_dir(place.folder()).unwrap().collect();
        assert!(files.is_empty(), "{arguments:?} left {files:?}");
    }
}

/// This build has no tests of workers on other hosts either.
#[cfg(not(feature = "hosts"))]
#[test]
fn a_build_without_other_hosts_names_the_command_that_adds_them() {
    let what = "runs on several hosts";
    let remedy = "cargo test --release --features hosts";
    dmprl_tests::skipped::skipped("TEST_BRIDGE_REQUIRED", what, remedy);
    let (place, expected) = (Workplace::new(), "cargo build --release --features hosts");
    let token = place.path("token");
    fs::write(&token, "").unwrap();
    for arguments in [
        &["train", "reacher", "--set", "bridge.listen=[\"tcp/127.0.0.1:7447\"]"][..],
        &["bridge", "--connect", "tcp/127.0.0.1:7447", "--token-file", &token],
        &["bench", "transport", "--listen", "tcp/127.0.0.1:7447"],
    ] {
        place.run(arguments).with_status(2).saying(expected);
    }
}

/// A worker that reported it would write `null`, which readers of the report cannot parse as a
/// number.
#[test]
fn an_environment_whose_step_lasts_no_time_is_refused_by_its_worker() {
    let (place, folder) = (Workplace::new(), dmprl_tests::tiny_envs_dir());
    let more = ["--workers", "1", "--python-path", folder.to_str().unwrap()];
    let run = place.path("run");
    let finished = place.run(&crate::train("tiny_envs:Timeless", &run, &more)).with_status(1);
    finished
        .saying(
            "tiny_envs:Timeless: the duration of a step (the environment's attribute dt) is NaN",
        )
        .saying("exit status 1");
    place.assert_no_process();
}

/// It would never be imported, because the standard library comes first.
#[test]
fn a_module_with_the_name_of_a_standard_one_is_refused() {
    let place = Workplace::new();
    let folder = place.path("modules");
    fs::create_dir(&folder).unwrap();
    fs::write(place.path("modules/random.py"), "raise AssertionError").unwrap();
    let run = place.path("run");
    let more = ["--workers", "1", "--python-path", &folder];
    let finished = place.run(&crate::train("reacher", &run, &more)).with_status(1);
    finished.saying("modules/random").saying("rename yours");
    place.assert_no_process();
}

#[test]
fn a_run_that_is_being_trained_is_not_resumed_beside_itself() {
    let place = Workplace::new();
    let run = place.path("run");
    let mut running = place.start(&crate::train("reacher", &run, &["--steps", crate::ENDLESS]));
    running.until_steps(&run, 500);
    place.run(&crate::train("reacher", &run, &[])).with_status(2).saying("already holds files");
    // At once: `resume` waits only for the children of a dead supervisor.
    let resumed = place.run(&["resume", &run]).with_status(1).saying("is being trained by process");
    assert!(!resumed.said.contains("waiting"), "{}", resumed.said);
    let steps = dmprl_tests::program::env_steps_of(&run).unwrap();
    running.until_steps(&run, steps + 500);
}
