//! `dmprl report` over runs and a sweep that were really trained.

use std::fs;
use std::path::Path;

use dmprl_tests::program::Workplace;

use crate::{ENDLESS, SMALL, train};

#[test]
fn a_sweep_is_reported_with_what_was_run_and_what_was_not() {
    let place = Workplace::new();
    let file = place.path("two.toml");
    let method = "[[method]]\nname = 'td3-dmp'\nlabel = 'TD3-DMP'\n";
    let head = "seeds = [1, 2]\n[[task]]\nname = 'reacher-v1'\nsteps = 50000\n";
    // Any return will do: the runs end with their first evaluation, and have come to their end.
    let set = format!("[set]\nrun.until_return = -1000\n{}", SMALL.join("\n"));
    fs::write(&file, format!("{head}{method}{set}")).unwrap();
    place.run(&["sweep", &file, "--output", "two"]).with_status(0);
    // Asked for since, and not run: the paper's figures stand beside nothing.
    let paper = "[[method]]\nname = 'ndp'\nlabel = 'NDP'\nalgo = 'ndp'\n";
    fs::write(place.path("two/sweep.toml"), format!("{head}{method}{paper}{set}")).unwrap();

    let without = place.run(&["report", "two", "--no-motion", "--json"]).with_status(0).json();
    let titles = |json: &serde_json::Value| -> Vec<String> {
        let tables = json["tables"].as_array().unwrap().iter();
        tables.map(|table| table["title"].as_str().unwrap().to_owned()).collect()
    };
    assert!(!titles(&without).iter().any(|title| title.contains("jerk")));
    let json = place.run(&["report", "two", "--json"]).with_status(0).json();
    assert!(titles(&json).iter().any(|title| title == "Smoothness: joint jerk [rad/s³]"));
    assert_eq!(json["methods"], serde_json::json!(["TD3-DMP", "NDP"]));
    let returns = &json["tables"][0];
    assert_eq!(returns["title"], "Average return");
    let cells = &returns["rows"][0][1];
    assert_eq!(cells[0]["summary"]["count"], 2);
    assert!(cells[1]["summary"].is_null());
    assert_eq!(cells[1]["paper"], serde_json::json!([-15.56, 1.47]));
    // Two seeds that ended before they learnt anything: told, and nothing made of it.
    let efficiency = &json["efficiency"][0];
    assert_eq!(efficiency["threshold"], "return ≥ -10");
    assert_eq!(efficiency["cells"][0]["steps"].as_array().unwrap().len(), 2);
    let verdicts = json["statements"].as_array().unwrap().iter();
    let verdicts: Vec<_> =
        verdicts.map(|it| it["findings"][0]["verdict"].as_str().unwrap()).collect();
    assert!(verdicts.contains(&"cannot_hold") && verdicts.contains(&"not_run"), "{verdicts:?}");
    assert!(!verdicts.contains(&"held"), "{verdicts:?}");

    let read = |name: &str| fs::read_to_string(place.path(&format!("two/report/{name}"))).unwrap();
    let page = read("index.html");
    for text in ["reacher-v1", "TD3-DMP", "not run", "paper -15.56 ± 1.47", "2 seeds", "<svg"] {
        assert!(page.contains(text), "{text} is not on the page");
    }
    for (link, own) in [("src=\"", "src=\"data:"), ("href=\"", "href=\"#")] {
        assert_eq!(page.matches(link).count(), page.matches(own).count(), "it needs nothing else");
    }
    for seed in [1, 2] {
        let motion = place.path(&format!("two/reacher-v1/td3-dmp/seed-{seed}/motion.json"));
        assert!(Path::new(&motion).is_file(), "{motion}: measured once, and kept");
    }
    assert!(read("joints/reacher-v1-velocity.svg").contains("joint velocity [rad/s]"));
    assert!(Path::new(&place.path("two/report/joints/reacher-v1-position.png")).is_file());
    for heading in ["What was run", "Sample efficiency", "What held of the paper"] {
        assert!(page.contains(heading), "{heading} is not on the page");
    }
    assert!(read("report.md").contains("| reacher-v1 |"));
    assert!(read("curves/reacher-v1-evaluation-return.svg").starts_with("<svg"));
    let png = fs::read(place.path("two/report/curves/reacher-v1-evaluation-return.png")).unwrap();
    assert_eq!(&png[1..4], b"PNG");
    let data: serde_json::Value = serde_json::from_str(&read("report-data.json")).unwrap();
    assert_eq!(data["runs"].as_array().unwrap().len(), 2);
    assert!(!data["runs"][0]["return_mean"].as_array().unwrap().is_empty());
    // One line an evaluation of each seed, and a head.
    assert!(read("runs.csv").lines().count() > 2);
    assert!(read("figures.csv").contains("Average return,reacher-v1,NDP,0,,,,,,-15.56,1.47"));

    its_report_says_the_same_once_the_runs_are_gone(&place, &json);
}

/// Written over itself: all of it is read first.
fn its_report_says_the_same_once_the_runs_are_gone(place: &Workplace, json: &serde_json::Value) {
    let read = |name| fs::read_to_string(place.path(&format!("two/report/{name}"))).unwrap();
    let files = ["report-data.json", "runs.csv", "figures.csv", "joints/reacher-v1-velocity.svg"];
    let before = files.map(read);
    fs::remove_dir_all(place.path("two/reacher-v1")).unwrap();
    let landed = ["report", "two/report", "--output", "two/report", "--json"];
    let again = place.run(&landed).with_status(0).json();
    assert_eq!(again, *json);
    assert_eq!(files.map(read), before);
    assert!(read("report.md").contains("Of 4 runs 2 have come to their end, 2 not begun."));
}

#[test]
fn what_is_no_run_or_has_no_evaluation_is_refused() {
    let place = Workplace::new();
    place.run(&["report", "nowhere"]).with_status(2).saying("nowhere");
    let run = place.path("run");
    let mut training = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    training.until("a run directory", |_| Path::new(&run).join("manifest.json").is_file());
    training.signal_group(rustix::process::Signal::INT);
    training.wait();
    place.run(&["report", &run]).with_status(2).saying("no run has an evaluation");
}

#[test]
fn runs_of_another_preset_have_a_column_of_their_own() {
    let place = Workplace::new();
    let runs = [("ours", "default"), ("theirs", "paper")].map(|(name, preset)| {
        let run = place.path(name);
        let more = ["--algo", "ddpg", "--preset", preset, "--steps", "500"];
        place.run(&train("reacher", &run, &more)).with_status(0);
        run
    });
    let json = place.run(&["report", &runs[0], &runs[1], "--no-motion", "--json"]).json();
    assert_eq!(json["methods"], serde_json::json!(["DDPG-DMP", "DDPG-DMP (paper)"]));
    // However it was said: another seed is one of the method's, another value another method.
    let [seed, value] =
        [("seed", "run.seed=3"), ("value", "dmp.alpha_y=9.0")].map(|(name, set)| {
            let run = place.path(name);
            let more = ["--algo", "ddpg", "--steps", "500", "--set", set];
            place.run(&train("reacher", &run, &more)).with_status(0);
            run
        });
    let runs = ["report", &runs[0], &seed, &value, "--no-motion", "--json"];
    let json = place.run(&runs).with_status(0).json();
    assert_eq!(json["methods"], serde_json::json!(["DDPG-DMP", "DDPG-DMP, dmp.alpha_y=9.0"]));
}

#[test]
fn a_run_whose_environment_is_gone_is_reported_without_its_motion() {
    let place = Workplace::new();
    let (run, folder) = (place.path("run"), place.path("envs"));
    let example = dmprl_tests::project_root().join("docs/examples/point_reach.py");
    fs::create_dir(&folder).unwrap();
    fs::copy(example, format!("{folder}/point_reach.py")).unwrap();
    let more = ["--steps", "1000", "--python-path", &folder];
    place.run(&train("point_reach:PointReach-v0", &run, &more)).with_status(0);
    fs::remove_dir_all(&folder).unwrap();
    let ended = place.run(&["report", &run]).with_status(0);
    ended
        .saying("motion not measured: point_reach:PointReach-v0")
        .saying("cannot be a Python path");
    let page = fs::read_to_string(place.path("report/index.html")).unwrap();
    assert!(page.contains("Motion is not measured of 1 run"), "the page says so too");
    assert!(!page.contains("What held of the paper"), "a task of one's own is not the paper's");
}
