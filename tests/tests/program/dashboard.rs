//! `dmprl dashboard` over real HTTP, during and after a run, and the requests that it refuses.

use std::collections::BTreeSet;
use std::fs;
use std::net::TcpStream;
use std::os::unix::fs::symlink;
use std::path::Path;

use dmprl_tests::program::{Running, Workplace, until};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::http::{Answer, request};
use crate::{ENDLESS, train};

/// The dashboard's address, from its URL on standard output.
pub struct Address {
    /// Host and port.
    pub host: String,
    pub token: String,
}

impl Address {
    /// The URL that the dashboard printed.
    pub fn url(&self) -> String {
        format!("http://{}/?token={}", self.host, self.token)
    }
}

/// Starts it on any port.
pub fn start(place: &Workplace, directory: &str) -> (Running, Address) {
    start_with(place, &["dashboard", directory, "--port", "0"])
}

fn start_with(place: &Workplace, args: &[&str]) -> (Running, Address) {
    let mut running = place.start(args);
    running.until("an address", |running| running.printed().ends_with('\n'));
    let url = running.printed().trim().strip_prefix("http://").unwrap().to_owned();
    let (host, token) = url.split_once("/?token=").unwrap();
    let address = Address { host: host.to_owned(), token: token.to_owned() };
    (running, address)
}

/// Sends GET with the token.
fn get(address: &Address, path: &str) -> Answer {
    let Address { host, token } = address;
    let head = format!("Host: {host}\r\nAuthorization: Bearer {token}\r\n");
    request(host, &format!("GET {path} HTTP/1.1\r\n{head}"))
}

/// Returns the entry of a run in the list.
fn listed(address: &Address, run: &str) -> Option<Value> {
    let answer = get(address, "/api/runs").json();
    answer["runs"].as_array().unwrap().iter().find(|one| one["name"] == run).cloned()
}

fn curves(address: &Address, query: &str) -> Value {
    get(address, &format!("/api/curves?run=one&file=metrics&names=env_steps_per_s&{query}")).json()
}

fn steps(answer: &Value) -> Vec<u64> {
    let steps = answer["curves"][0]["env_steps"].as_array().unwrap().iter();
    steps.map(|step| step.as_f64().unwrap() as u64).collect()
}

/// Returns every file below a folder.
fn files(folder: &Path) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        if entry.file_type().unwrap().is_dir() {
            found.extend(files(&entry.path()));
        } else {
            found.insert(entry.path().display().to_string());
        }
    }
    found
}

#[test]
fn a_run_that_begins_later_appears_grows_and_stays_when_it_has_ended() {
    let place = Workplace::new();
    let folder = place.path("runs");
    fs::create_dir(&folder).unwrap();
    let (dashboard, address) = start(&place, &folder);
    assert_eq!(get(&address, "/api/runs").json()["runs"], json!([]));

    let run = place.path("runs/one");
    let training = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    let is = |state: &str| listed(&address, "one").is_some_and(|one| one["state"] == state);
    until("a run in training", || is("training"));
    until("a first point", || !steps(&curves(&address, "")).is_empty());
    let first = curves(&address, "");
    let query = format!("table={}&from={}", first["table"], first["next"]);
    until("a new point", || !steps(&curves(&address, &query)).is_empty());
    let more = curves(&address, &query);
    assert_eq!(more["table"], first["table"]);
    let last = *steps(&first).last().unwrap();
    assert!(steps(&more).iter().all(|step| *step > last), "only new rows: {more}");
    let running = |name: &str| {
        let answer = get(&address, "/api/processes?run=one").json();
        let rows = answer["session"]["processes"].as_array().cloned().unwrap_or_default();
        rows.iter().any(|row| row["name"] == name && row["state"] == "running")
    };
    for name in ["learner", "actor-0", "evaluator"] {
        until(name, || running(name));
    }
    let text = get(&address, "/metrics").text();
    let labels = r#"{run="one",task="reacher",algorithm="td3",policy="dmp",seed="1"}"#;
    assert!(text.contains(&format!("dmprl_training{labels} 1.0\n")), "{text}");
    until("an evaluation", || {
        let rows = get(&address, "/api/evaluations?run=one").json();
        rows["count"].as_u64().unwrap() > 0
    });

    training.signal_group(Signal::INT);
    training.wait().with_status(130);
    until("a run that has stopped", || is("stopped"));
    let answer = get(&address, "/api/processes?run=one").json();
    assert_eq!(answer["session"]["ended"], true);
    let before = files(Path::new(&folder));
    let entry = listed(&address, "one").unwrap();
    for (key, expected) in [("task", json!("reacher")), ("method", json!("TD3-DMP"))] {
        assert_eq!(entry[key], expected);
    }
    assert_eq!(entry["colour"], "#009e73", "as in every plot");
    let rows = dmprl_tests::program::env_steps(&dmprl_tests::program::rows(&run, "metrics.jsonl"));
    assert_eq!(steps(&curves(&address, "")), rows);
    let metrics = get(&address, "/metrics");
    assert!(metrics.head.contains("content-type: application/openmetrics-text"));
    let text = metrics.text();
    check_exposition(&text);
    let steps = rows.last().unwrap();
    assert!(text.contains(&format!("dmprl_env_steps_total{labels} {steps}.0\n")), "{text}");
    assert!(text.contains(&format!("dmprl_training{labels} 0.0\n")), "{text}");
    let config = get(&address, "/api/config?run=one").json();
    assert_eq!(config["keys"]["algorithm.batch_size"], "32");
    assert_eq!(files(Path::new(&folder)), before, "it only reads");

    dashboard.signal_group(Signal::INT);
    dashboard.wait().with_status(0);
    assert!(TcpStream::connect(&address.host).is_err());
}

/// Checks the exposition format: each family is announced once, with a type, before its samples.
fn check_exposition(text: &str) {
    let mut announced = BTreeSet::new();
    let mut samples = 0;
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').unwrap();
            assert!(["counter", "gauge"].contains(&kind), "{line}");
            assert!(announced.insert(name.to_owned()), "twice: {line}");
            assert!(text.contains(&format!("# HELP {name} ")), "{name} has no help");
        } else if !line.starts_with('#') {
            let name = line.split('{').next().unwrap();
            let family = name.strip_suffix("_total").unwrap_or(name);
            assert!(announced.contains(family), "not announced: {line}");
            line.rsplit_once(' ').unwrap().1.parse::<f64>().unwrap();
            samples += 1;
        }
    }
    assert!(samples > 20, "{text}");
    assert!(text.ends_with("# EOF\n"));
}

#[test]
fn only_runs_and_their_videos_are_served_and_only_to_this_machine() {
    let place = Workplace::new();
    let run = place.path("runs/one");
    fs::create_dir(place.path("runs")).unwrap();
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    let (_dashboard, address) = start(&place, &place.path("runs"));
    let status = |path: &str| get(&address, path).status;

    let page = get(&address, "/");
    assert_eq!(page.status, 200);
    assert!(page.text().contains("<title>dmprl dashboard</title>"));
    assert!(page.head.contains("content-security-policy: default-src 'none'"), "{}", page.head);
    for part in page.text().split(['"', '\'']).filter(|part| part.starts_with("/page/")) {
        assert_eq!(status(part), 200, "{part}");
    }

    let video = b"not really a film, but bytes".as_slice();
    fs::write(format!("{run}/videos/made.mp4"), video).unwrap();
    fs::write(format!("{run}/videos/notes.txt"), "mine").unwrap();
    symlink(format!("{run}/config.toml"), format!("{run}/videos/link.mp4")).unwrap();
    let names = get(&address, "/api/videos?run=one").json();
    assert_eq!(names["videos"], json!([{"name": "made.mp4", "bytes": video.len()}]));
    assert_eq!(get(&address, "/video?run=one&name=made.mp4").body, video);
    let head = format!("Host: {}\r\nAuthorization: Bearer {}\r\n", address.host, address.token);
    let film = "GET /video?run=one&name=made.mp4 HTTP/1.1";
    let part = request(&address.host, &format!("{film}\r\n{head}Range: bytes=4-9\r\n"));
    assert_eq!((part.status, part.body.as_slice()), (206, &video[4..10]));

    for path in [
        "/nothing",
        "/page/",
        "/page/../mod.rs",
        "/page/%2e%2e/server.rs",
        "/../../../../etc/passwd",
        "/runs/one/config.toml",
        "/api/config?run=two",
        "/api/config?run=..",
        "/api/config?run=../runs/one",
        "/api/config?run=/etc",
        "/video?run=one&name=notes.txt",
        "/video?run=one&name=link.mp4",
        "/video?run=one&name=../config.toml",
        "/video?run=one&name=..%2Fconfig.toml",
    ] {
        let answer = get(&address, path);
        assert_eq!(answer.status, 404, "{path}: {}", answer.text());
        assert!(answer.text().contains("error"), "{path}: {}", answer.text());
    }
    assert_eq!(status("/api/curves?run=one&file=lock&names=a"), 400);
    assert_eq!(status("/api/curves?run=one"), 400);
    let post = request(&address.host, &format!("POST /api/runs HTTP/1.1\r\n{head}"));
    assert_eq!(post.status, 405);
    // A page of another site whose host name resolves to 127.0.0.1.
    for host in ["Host: evil.example\r\n", "Host: evil.example:8787\r\n", "Host: \r\n"] {
        let lines = format!("GET /api/runs?token={} HTTP/1.1\r\n{host}", address.token);
        let answer = request(&address.host, &lines);
        assert_eq!(answer.status, 403, "{host}");
        assert!(!answer.text().contains("reacher"));
    }
    let port = address.host.rsplit_once(':').unwrap().1;
    let ended = place.run(&["dashboard", "runs", "--port", port]).with_status(1);
    ended.saying("choose another --port");
    place.run(&["dashboard", "nowhere"]).with_status(2).saying("there is no directory nowhere");
}

#[test]
fn another_user_of_the_machine_needs_the_token() {
    let place = Workplace::new();
    let run = place.path("runs/one");
    fs::create_dir(place.path("runs")).unwrap();
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    let file = place.path("dashboard.token");
    let args = ["dashboard", &place.path("runs"), "--port", "0", "--token-file", &file];
    let (dashboard, address) = start_with(&place, &args);
    let Address { host, token } = &address;
    let ask = |path: &str, more: &str| {
        request(host, &format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n{more}"))
    };
    for path in ["/", "/api/runs", "/metrics", "/page/main.js", "/video?run=one&name=a.mp4", "/no"]
    {
        for more in ["", "Authorization: Bearer 0123456789abcdef\r\n"] {
            let answer = ask(path, more);
            assert_eq!(answer.status, 401, "{path}: {}", answer.text());
            assert!(answer.text().contains("open the address"), "{path}: {}", answer.text());
            assert!(!answer.text().contains(token.as_str()) && !answer.text().contains("reacher"));
        }
    }
    // The printed URL gives the browser a cookie, and leads to a URL without the token.
    let first = ask(&format!("/?token={token}"), "");
    assert_eq!(first.status, 303);
    let header = |name: &str| {
        let line = first.head.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        line.trim().to_owned()
    };
    assert_eq!(header("location:"), "/");
    let cookie = header("set-cookie:");
    assert!(cookie.contains("httponly") && cookie.contains("samesite=lax"), "{cookie}");
    let cookie = format!("Cookie: {}\r\n", cookie.split(';').next().unwrap());
    assert_eq!(ask("/", &cookie).status, 200);
    assert_eq!(ask("/api/runs", &cookie).status, 200);
    // As Prometheus gives it.
    assert_eq!(ask("/metrics", &format!("Authorization: Bearer {token}\r\n")).status, 200);
    assert_eq!(ask(&format!("/metrics?token={token}"), "").status, 200);

    dashboard.signal_group(Signal::INT);
    dashboard.wait().with_status(0);
    let (dashboard, again) = start_with(&place, &args);
    assert_eq!(again.token, *token, "the token of the file");
    drop(dashboard);
    let (_dashboard, other) = start(&place, &place.path("runs"));
    assert_ne!(other.token, *token);
    fs::write(&file, "with a space, 16 characters").unwrap();
    place.run(&args).with_status(2).saying("expected letters, digits");
}

#[test]
fn a_rollout_that_was_measured_is_shown_joint_by_joint() {
    let place = Workplace::new();
    let run = place.path("one");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    // The run itself instead of a folder of runs.
    let (_dashboard, address) = start(&place, &run);
    assert_eq!(get(&address, "/api/motion?run=one").json(), Value::Null);
    place.run(&["report", &run]).with_status(0);
    let motion = get(&address, "/api/motion?run=one").json();
    let lengths = |key: &str| -> Vec<usize> {
        let columns = motion[key].as_array().unwrap().iter();
        columns.map(|column| column.as_array().unwrap().len()).collect()
    };
    let rows = motion["times"].as_array().unwrap().len();
    assert_eq!(motion["joints"].as_array().unwrap().len(), 2);
    assert_eq!(lengths("positions"), [rows, rows]);
    assert_eq!(lengths("velocities"), [rows, rows]);
    assert_eq!(lengths("actions"), [rows - 1, rows - 1]);
}

#[test]
fn a_restarted_worker_and_a_session_that_was_killed_are_told() {
    let place = Workplace::new();
    let run = place.path("one");
    let training = place.start(&train("reacher", &run, &["--steps", ENDLESS]));
    until("a run", || Path::new(&run).join("processes.json").is_file());
    let (_dashboard, address) = start(&place, &run);
    let actor = || {
        let answer = get(&address, "/api/processes?run=one").json();
        let rows = answer["session"]["processes"].as_array().cloned().unwrap_or_default();
        rows.into_iter().find(|row| row["name"] == "actor-0" && row["state"] == "running")
    };
    until("a worker", || actor().is_some());
    assert_eq!(actor().unwrap()["starts"], 1);
    place.process("actor").signal(Signal::KILL);
    until("another start", || actor().is_some_and(|row| row["starts"] == 2));
    training.signal_group(Signal::KILL);
    until("its end", || listed(&address, "one").is_some_and(|one| one["state"] == "stopped"));
    let answer = get(&address, "/api/processes?run=one").json();
    assert_eq!(answer["session"]["ended"], false, "killed, not ended");
}
