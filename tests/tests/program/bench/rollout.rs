//! `dmprl bench rollout` with real workers and peers.

use dmprl_tests::program::{Running, Workplace};
use rustix::process::{Pid, Signal};

use super::{assert_no_shared_memory, assert_no_temporary_files, assert_positive, start};

fn bench(place: &Workplace, task: &str, more: &[&str]) -> Running {
    let few = ["rollout", "--task", task, "--envs-per-worker", "2"];
    let small = ["--set", "policy.hidden=[16]", "--seconds", "0.3"];
    start(place, &[&few[..], &small, more].concat())
}

fn assert_nothing_left(place: &Workplace, process: Pid) {
    place.assert_no_process();
    assert_no_shared_memory(process);
    assert_no_temporary_files(place);
}

#[test]
fn a_task_on_the_batch_is_measured_beside_its_ceiling_and_gymnasium() {
    let place = Workplace::new();
    let running = bench(&place, "reacher", &["--workers", "2", "--rounds", "2", "--json"]);
    let id = running.id();
    let json = running.wait().with_status(0).json();
    for key in ["mujoco", "ceiling", "worker", "one_worker", "gymnasium"] {
        assert_positive(&json, &format!("{key}_steps_per_s"));
        assert_eq!(json["rounds"][key].as_array().unwrap().len(), 2, "{json}");
        assert!(json["cpu_us_per_step"][key].as_f64() > Some(0.0), "{json}");
    }
    for key in ["worker_to_ceiling", "worker_to_gymnasium", "first_segment_s", "worker_rss_mb"] {
        assert_positive(&json, key);
    }
    // With EnvPool in .venv there is a figure, otherwise null and the reason.
    let envpool = json.get("envpool_steps_per_s").unwrap();
    assert!(envpool.as_f64() > Some(0.0) || envpool.is_null(), "{json}");
    assert!(json["notes"]["envpool"].as_str().unwrap().contains("envpool"), "{json}");
    let sizes = (&json["workers"], &json["envs_per_worker"], &json["segment_steps"]);
    assert_eq!(sizes, (&2.into(), &2.into(), &5.into()));
    assert_eq!((&json["rejected"], &json["lost"]), (&0.into(), &0.into()), "{json}");
    assert_nothing_left(&place, id);
}

#[test]
fn a_task_without_a_batch_has_no_ceiling_and_a_gaussian_mlp_is_measured_too() {
    let place = Workplace::new();
    let gaussian = ["--algo", "sac", "--policy", "mlp", "--workers", "1", "--rounds", "1"];
    let running = bench(&place, "Pendulum-v1", &gaussian);
    let id = running.id();
    let finished = running.wait().with_status(0);
    let row = |name: &str| {
        let mut rows = finished.printed.lines().map(str::trim_start);
        rows.find(|row| row.starts_with(name)).unwrap_or_else(|| panic!("{}", finished.printed))
    };
    assert!(row("mujoco").ends_with("absent") && row("ceiling").ends_with("absent"));
    assert!(row("gymnasium").ends_with('×') && row("worker").contains('…'));
    assert!(finished.printed.contains("0 segments rejected, 0 lost"), "{}", finished.printed);
    assert!(finished.printed.contains("Pendulum-v1 does not run on mujoco.batch"));
    assert_nothing_left(&place, id);
}

#[test]
fn a_segment_env_of_ones_own_is_measured_alone() {
    let place = Workplace::new();
    let folder = dmprl_tests::tiny_envs_dir();
    let more = ["--workers", "1", "--rounds", "1", "--json", "--python-path"];
    let running =
        bench(&place, "tiny_envs:Timed", &[&more[..], &[folder.to_str().unwrap()]].concat());
    let json = running.wait().with_status(0).json();
    assert_positive(&json, "worker_steps_per_s");
    for absent in ["mujoco", "ceiling", "gymnasium", "envpool", "panda_gym"] {
        assert!(json[format!("{absent}_steps_per_s")].is_null(), "{json}");
        assert!(json["notes"][absent].is_string(), "{json}");
    }
}

/// A segment takes longer than the measurement, as it may on a busy machine.
#[test]
fn the_rate_of_a_slow_environment_is_not_zero() {
    let place = Workplace::new();
    let folder = dmprl_tests::tiny_envs_dir();
    let more = ["--workers", "1", "--rounds", "2", "--json", "--python-path"];
    let more = [&more[..], &[folder.to_str().unwrap()]].concat();
    let json = bench(&place, "tiny_envs:Slow", &more).wait().with_status(0).json();
    for round in json["rounds"]["worker"].as_array().unwrap() {
        assert!(round.as_f64() > Some(0.0), "{json}");
    }
}

#[test]
fn a_gymnasium_class_of_ones_own_is_measured_beside_gymnasiums_loop() {
    let place = Workplace::new();
    let folder = dmprl_tests::tiny_envs_dir();
    let more = ["--workers", "1", "--rounds", "1", "--json", "--python-path"];
    let running =
        bench(&place, "tiny_envs:Limited", &[&more[..], &[folder.to_str().unwrap()]].concat());
    let json = running.wait().with_status(0).json();
    assert_positive(&json, "worker_to_gymnasium");
}

/// The remaining parts are measured.
#[test]
fn an_interpreter_of_peers_that_is_none_makes_them_absent_with_its_last_word() {
    let place = Workplace::new();
    let interpreter = place.path("no-python");
    std::fs::write(&interpreter, "#!/bin/sh\necho no python here >&2\nexit 3\n").unwrap();
    let more = ["--workers", "1", "--rounds", "1", "--json", "--peer-python", &interpreter];
    // Not executable at first.
    for (mode, words) in [(0o600, "cannot start"), (0o700, "exit status 3, no python here")] {
        let permissions = std::os::unix::fs::PermissionsExt::from_mode(mode);
        std::fs::set_permissions(&interpreter, permissions).unwrap();
        let json = bench(&place, "panda-reach", &more).wait().with_status(0).json();
        assert_positive(&json, "worker_to_ceiling");
        for peer in ["envpool", "panda_gym"] {
            assert!(json[format!("worker_to_{peer}")].is_null(), "{json}");
            let note = json["notes"][peer].as_str().unwrap();
            assert!(note.contains(words), "{note}");
        }
    }
}

#[test]
fn an_environment_that_cannot_be_made_is_named_with_the_workers_own_words() {
    let place = Workplace::new();
    let running = bench(&place, "Reachr-v5", &["--workers", "1"]);
    let id = running.id();
    let finished =
        running.wait().with_status(1).saying("actor-0 died: exit status 1").saying("Reachr");
    // The folder of the logs is removed with the benchmark.
    assert!(!finished.said.contains("logs/"), "{}", finished.said);
    assert_nothing_left(&place, id);
}

#[test]
fn ctrl_c_ends_it_at_once_and_leaves_nothing() {
    let place = Workplace::new();
    let mut running = bench(&place, "reacher", &["--workers", "2", "--rounds", "1000", "--json"]);
    let id = running.id();
    running.until_said("round 2 of 1000");
    running.signal_group(Signal::INT);
    assert_eq!(running.wait().with_status(130).printed, "");
    assert_nothing_left(&place, id);
}

/// With two workers, one is also measured alone, while the other is stopped and must not be left
/// behind. The next start removes the shared memory of killed processes.
#[test]
fn a_killed_benchmark_takes_its_processes_with_it() {
    let place = Workplace::new();
    let mut running = bench(&place, "reacher", &["--workers", "2", "--rounds", "1000"]);
    running.until_said("round 2 of 1000");
    running.signal(Signal::KILL);
    place.until_no_process();
}
