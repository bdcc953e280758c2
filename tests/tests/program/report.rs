//! Tests `dmprl report` with trained runs and a trained sweep.

use std::fs;
use std::path::Path;

use dmprl_tests::program::Workplace;

use crate::{ENDLESS, SMALL, train};

#[test]
fn a_report_of_a_sweep_shows_runs_and_missing_runs() {
    let place = Workplace::new();
    let file = place.path("two.toml");
    let method = "[[method]]\nname = 'td3-dmp'\nlabel = 'TD3-DMP'\n";
    let head = "seeds = [1, 2]\n[[task]]\nname = 'reacher-v1'\nsteps = 50000\n";
    // Every return reaches the target, so the runs are finished after their first evaluation.
    let set = format!("[set]\nrun.until_return = -1000\n{}", SMALL.join("\n"));
    fs::write(&file, format!("{head}{method}{set}")).unwrap();
    place.run(&["sweep", &file, "--output", "two"]).with_status(0);
    // Add a method that was not run: its cells show only the paper's figures.
    let paper = "[[method]]\nname = 'ndp'\nlabel = 'NDP'\nalgo = 'ndp'\n";
    fs::write(place.path("two/sweep.toml"), format!("{head}{method}{paper}{set}")).unwrap();

    let without = place.run(&["report", "two", "--no-motion", "--json"]).with_status(0).json();
    let titles = |json: &serde_json::Value| -> Vec<String> {
        let tables = json["tables"].as_array().unwrap().iter();
        tables.map(|table| table["title"].as_str().unwrap().to_owned()).collect()
    };
    assert!(!titles(&without).iter().any(|title| title.contains("jerk")));
    let reported = place.run(&["report", "two", "--json", "--pareto"]).with_status(0);
    let json = reported.saying("not drawn: return against smoothness").json();
    assert!(titles(&json).iter().any(|title| title == "Smoothness: joint jerk [rad/s³]"));
    assert_eq!(json["methods"], serde_json::json!(["TD3-DMP", "NDP"]));
    let returns = &json["tables"][0];
    assert_eq!(returns["title"], "Average return");
    let cells = &returns["rows"][0][1];
    assert_eq!(cells[0]["summary"]["count"], 2);
    assert!(cells[1]["summary"].is_null());
    assert_eq!(cells[1]["paper"], serde_json::json!([-15.56, 1.47]));
    // Both seeds are finished and did not reach the threshold.
    let efficiency = &json["efficiency"][0];
    assert_eq!(efficiency["threshold"], "return ≥ -10");
    assert_eq!(efficiency["cells"][0]["steps"].as_array().unwrap().len(), 2);
    // Each statement of the paper is about a method that has no run.
    assert_eq!(json["statements"], serde_json::json!([]));

    its_files_show_the_same(&place);
    its_report_is_the_same_without_the_runs(&place, &json);
}

fn its_files_show_the_same(place: &Workplace) {
    let read = |name: &str| fs::read_to_string(place.path(&format!("two/report/{name}"))).unwrap();
    let page = read("index.html");
    for text in ["reacher-v1", "TD3-DMP", "not run", "paper -15.56 ± 1.47", "2 seeds", "<svg"] {
        assert!(page.contains(text), "{text} is not on the page");
    }
    for (link, own) in [("src=\"", "src=\"data:"), ("href=\"", "href=\"#")] {
        assert_eq!(
            page.matches(link).count(),
            page.matches(own).count(),
            "the page is self-contained"
        );
    }
    for seed in [1, 2] {
        let motion = place.path(&format!("two/reacher-v1/td3-dmp/seed-{seed}/motion.json"));
        assert!(Path::new(&motion).is_file(), "{motion}: the motion is kept in the run");
    }
    assert!(read("joints/reacher-v1-velocity.svg").contains("joint velocity [rad/s]"));
    assert!(Path::new(&place.path("two/report/joints/reacher-v1-position.png")).is_file());
    for heading in ["What was run", "Sample efficiency"] {
        assert!(page.contains(heading), "{heading} is not on the page");
    }
    assert!(!page.contains("Statements of the paper"));
    assert!(read("report.md").contains("| reacher-v1 |"));
    assert!(read("curves/reacher-v1-evaluation-return.svg").starts_with("<svg"));
    let png = fs::read(place.path("two/report/curves/reacher-v1-evaluation-return.png")).unwrap();
    assert_eq!(&png[1..4], b"PNG");
    let data: serde_json::Value = serde_json::from_str(&read("report-data.json")).unwrap();
    assert_eq!(data["runs"].as_array().unwrap().len(), 2);
    assert!(!data["runs"][0]["return_mean"].as_array().unwrap().is_empty());
    // A header, and a line per evaluation of each seed.
    assert!(read("runs.csv").lines().count() > 2);
    assert!(read("figures.csv").contains("Average return,reacher-v1,NDP,0,,,,,,-15.56,1.47"));
}

/// Writes the report over the one that it reads.
fn its_report_is_the_same_without_the_runs(place: &Workplace, json: &serde_json::Value) {
    let read = |name| fs::read_to_string(place.path(&format!("two/report/{name}"))).unwrap();
    let files = ["report-data.json", "runs.csv", "figures.csv", "joints/reacher-v1-velocity.svg"];
    let before = files.map(read);
    fs::remove_dir_all(place.path("two/reacher-v1")).unwrap();
    let arguments = ["report", "two/report", "--output", "two/report", "--json"];
    let again = place.run(&arguments).with_status(0).json();
    assert_eq!(again, *json);
    assert_eq!(files.map(read), before);
    assert!(read("report.md").contains("2 of 4 runs are finished, 2 not started."));
}

#[test]
fn a_path_without_a_run_and_a_run_without_an_evaluation_are_errors() {
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
fn runs_of_another_preset_have_their_own_column() {
    let place = Workplace::new();
    let runs = [("ours", "default"), ("theirs", "paper")].map(|(name, preset)| {
        let run = place.path(name);
        let more = ["--algo", "ddpg", "--preset", preset, "--steps", "500"];
        place.run(&train("reacher", &run, &more)).with_status(0);
        run
    });
    let json = place.run(&["report", &runs[0], &runs[1], "--no-motion", "--json"]).json();
    assert_eq!(json["methods"], serde_json::json!(["DDPG-DMP", "DDPG-DMP (paper)"]));
    // A run with another seed belongs to the same method, one with another value does not.
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
    assert!(page.contains("The motion of 1 run was not measured"), "the page says so");
    assert!(!page.contains("Statements of the paper"), "the task is not the paper's");
}
