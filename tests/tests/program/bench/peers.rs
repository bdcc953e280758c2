//! `dmprl bench peers` with real trainings, and a script in place of the other libraries.

use std::os::unix::fs::PermissionsExt;

use dmprl_tests::program::{Running, Workplace};
use rustix::process::Signal;

use super::{assert_no_temporary_files, start};

/// Answers as `tests/peers/agent_peer.py` does, with the batch size of its settings as description.
const PEER: &str = r#"#!/bin/sh
echo '{"ready": "'$(grep -o 'batch_size":[0-9]*' "$4" | tr -d '"')'"}'
times='"start_s": 0.5, "evaluation_s": 0.1'
echo '{"ended": false, "env_steps": 50, "evaluated": null, '"$times"'}'
evaluated='{"return_mean": -3.0, "success_rate": null}'
echo '{"ended": true, "env_steps": 100, "evaluated": '"$evaluated, $times"'}'
"#;

fn bench(place: &Workplace, peer_python: &str, more: &[&str]) -> Running {
    let python = ["peers", "--task", "Pendulum-v1", "--peer-python", peer_python];
    let small = ["--workers", "1", "--set", "policy.hidden=[16]"];
    let often = ["--set", "evaluation.interval_steps=500", "--set", "evaluation.episodes=2"];
    start(place, &[&python[..], &small, &often, more].concat())
}

/// Returns the path of an interpreter that runs `PEER` instead of a script.
fn stand_in(place: &Workplace) -> String {
    let python = place.path("python");
    std::fs::write(&python, PEER).unwrap();
    std::fs::set_permissions(&python, PermissionsExt::from_mode(0o700)).unwrap();
    python
}

#[test]
fn each_seed_is_trained_until_the_target_by_all() {
    let place = Workplace::new();
    let python = stand_in(&place);
    let target = ["--until-return", "-1e6", "--seeds", "2", "--peer", "sbx-sac", "--json"];
    let finished = bench(&place, &python, &target).wait().with_status(0);
    let json = finished.json();
    for (name, steps) in [("ours", 500), ("sbx-sac", 100)] {
        let candidate = &json["candidates"][name];
        assert_eq!(candidate["reached"], 2, "{json}");
        assert!(candidate["median_s"].as_f64() > Some(0.0), "{json}");
        for training in candidate["trainings"].as_array().unwrap() {
            assert!(training["env_steps"].as_u64() >= Some(steps), "{json}");
            assert!(training["start_s"].as_f64() > Some(0.0), "{json}");
        }
    }
    assert_eq!(json["target"]["value"], -1e6, "{json}");
    assert!(json["candidates"]["sbx-sac"]["ratio"].as_f64() < Some(1.0), "{json}");
    place.assert_no_process();
    assert_no_temporary_files(&place);
}

#[test]
fn last_policies_are_compared_if_there_is_no_target() {
    let place = Workplace::new();
    let python = stand_in(&place);
    let time = ["--max-minutes", "0.05", "--seeds", "2", "--peer", "sbx-simba"];
    let finished = bench(&place, &python, &[&time[..], &["--json"]].concat()).wait();
    let json = finished.with_status(0).json();
    assert!(json["target"].is_null(), "{json}");
    let (ours, peer) = (&json["candidates"]["ours"], &json["candidates"]["sbx-simba"]);
    assert_eq!(peer["return"]["mean"], -3.0, "{json}");
    assert_eq!(ours["return"]["count"], 2, "{json}");
    assert!(ours["success"].is_null(), "Pendulum reports no success: {json}");
    for training in ours["trainings"].as_array().unwrap() {
        // Longer than the 0.05 minutes, because start and evaluation are added.
        assert!(training["seconds"].as_f64() >= Some(3.0), "{json}");
        assert!(training["env_steps"].as_u64() > Some(0), "{json}");
    }
    let table = bench(&place, &python, &time).wait().with_status(0).printed;
    assert!(table.contains("after 0.05 minutes"), "{table}");
    assert!(table.contains("-3.00  (-3.00 to -3.00)"), "{table}");
}

#[test]
fn ctrl_c_reports_the_trainings_that_have_ended() {
    let place = Workplace::new();
    let python = place.path("python");
    std::fs::write(&python, "#!/bin/sh\necho '{\"ready\": \"waits\"}'\nexec sleep 600\n").unwrap();
    std::fs::set_permissions(&python, PermissionsExt::from_mode(0o700)).unwrap();
    let target = ["--until-return", "-1e6", "--seeds", "2", "--peer", "sb3-sac"];
    let interrupted = |output: &[&str]| {
        let mut running = bench(&place, &python, &[&target, output].concat());
        running.until_said("ours: return");
        running.signal_group(Signal::INT);
        running.wait().with_status(130)
    };
    let json = interrupted(&["--json"]).json();
    assert_eq!(json["interrupted"], true, "{json}");
    let trained =
        |name: &str| json["candidates"][name]["trainings"].as_array().map(|them| them.len());
    assert_eq!((trained("ours"), trained("sb3-sac")), (Some(1), Some(0)), "{json}");
    let table = interrupted(&[]).printed;
    assert!(table.contains("\ninterrupted: only the trainings that had ended\n"), "{table}");
    place.assert_no_process();
    assert_no_temporary_files(&place);
}

#[test]
fn a_peer_has_its_own_settings_unless_ours_are_asked_for() {
    for (more, note) in [(&[][..], ""), (&["--equal-settings"][..], "batch_size:32")] {
        let place = Workplace::new();
        let python = stand_in(&place);
        let batch = ["--set", "algorithm.batch_size=32"];
        let target = ["--until-return", "-1e6", "--seeds", "1", "--peer", "sb3-sac", "--json"];
        let finished = bench(&place, &python, &[&batch[..], &target[..], more].concat()).wait();
        let json = finished.with_status(0).json();
        assert_eq!(json["equal_settings"], !more.is_empty(), "{json}");
        assert_eq!(json["candidates"]["sb3-sac"]["note"], note, "{json}");
    }
}

#[test]
fn a_missing_library_and_a_missed_target_are_reported() {
    let place = Workplace::new();
    let python = dmprl_tests::venv().executable.display().to_string();
    let limits = ["--until-return", "1e6", "--seeds", "1", "--steps", "1000"];
    let finished = bench(&place, &python, &limits).wait().with_status(0);
    let row = |name: &str| {
        let mut rows = finished.printed.lines().map(str::trim_start);
        rows.find(|row| row.starts_with(name)).unwrap_or_else(|| panic!("{}", finished.printed))
    };
    assert!(row("ours").contains("0/1") && row("ours").contains("unknown"));
    assert!(row("sb3-td3").contains("absent: ") && row("sb3-td3").contains("--peer-python"));
}
