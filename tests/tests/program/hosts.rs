//! A run over three hosts: network namespaces with their own addresses, on a wire with delay, loss
//! and interruptions.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use dmprl_tests::hosts::Hosts;
use dmprl_tests::program::{
    Running, Workplace, executable, json_file, process_naming, rows, shared_memory_of,
};
use dmprl_tests::project_root;
use dmprl_tests::skipped::skipped;
use rustix::process::Signal;

use crate::{ENDLESS, train};

/// Bytes in transit of a connection of these tests.
const TCP_BYTES_MAX: usize = 16 << 20;
/// The workers of other hosts follow the run's own, and the four that may join.
const REMOTE: usize = 5;
const PORT: u16 = 7447;

/// Makes three hosts; `None`, and the test is skipped, if that is impossible.
fn three_hosts(seed: u64) -> Option<Hosts> {
    match Hosts::new(3, TCP_BYTES_MAX, seed) {
        Ok(hosts) => Some(hosts),
        Err(error) => {
            let what = format!("runs on several hosts in network namespaces ({error})");
            let remedy = "run the tests as root, with /dev/net/tun";
            skipped("TEST_HOSTS_REQUIRED", &what, remedy);
            None
        }
    }
}

fn start(place: &Workplace, hosts: &Hosts, host: usize, arguments: &[&str]) -> Running {
    let mut command = Command::new(executable());
    command.args(arguments);
    hosts.place(host, &mut command);
    place.start_command(command)
}

/// Returns the segments of each other host's worker in the newest checkpoint.
fn learned(run: &str) -> [u64; 2] {
    let state = json_file(run, "checkpoints/latest/state.json");
    [0, 1].map(|host| state["settled"][REMOTE + host]["sequence"].as_u64().unwrap_or(0))
}

/// Waits until segments of each of these hosts were learned from.
fn until_more(running: &mut Running, run: &str, hosts: &[usize], what: &str) {
    let before = learned(run);
    running.until(what, |_| {
        let now = learned(run);
        hosts.iter().all(|&host| now[host] > before[host] + 20)
    });
}

fn bridge_arguments<'a>(
    token: &'a str,
    endpoint: &'a str,
    name: &'a str,
    run: &'a str,
) -> Vec<&'a str> {
    let asks = ["bridge", "--connect", endpoint, "--token-file", token];
    let own = ["--workers", "1", "--name", name, "--run-dir", run];
    [&asks[..], &own].concat()
}

#[test]
fn three_hosts_lose_nothing_on_a_long_lossy_wire_that_is_cut_while_processes_die() {
    let Some(hosts) = three_hosts(1) else { return };
    let place = Workplace::new();
    let (run, far) = (place.path("run"), ["near", "far"].map(|name| place.path(name)));
    let endpoint = format!("tls/{}:{PORT}", hosts.address(0));
    let listen = format!("bridge.listen=[\"{endpoint}\"]");
    let open = ["--workers", "1", "--set", &listen, "--set", "delivery.level=log"];
    let more = [&open[..], &["--steps", ENDLESS]].concat();
    let mut training = start(&place, &hosts, 0, &train("reacher", &run, &more));
    let token = format!("{run}/bridge.token");
    training.until("a token", |_| Path::new(&token).is_file());
    let mut bridges = [0, 1].map(|host| {
        let name = ["near", "far"][host];
        let arguments = bridge_arguments(&token, &endpoint, name, &far[host]);
        let bridge = start(&place, &hosts, host + 1, &arguments);
        // Started first, it gets the first place, which identifies its segments.
        training.until_said(&format!("host {name} takes part"));
        bridge
    });
    until_more(&mut training, &run, &[0, 1], "segments of both hosts");

    hosts.delay(Duration::from_millis(100));
    hosts.lose(0.01);
    until_more(&mut training, &run, &[0, 1], "segments over a long wire that loses some");
    for seconds in [1, 10] {
        cut(&hosts, &mut training, &run, seconds);
    }
    training.until_said("host far is out of reach");
    bridges[1].until_said("the learner's host is back");
    hosts.delay(Duration::from_millis(10));
    for (run_of, role) in [(&far[0], "relay"), (&run, "gateway"), (&run, "learner")] {
        process_naming(run_of, role).signal(Signal::KILL);
        until_more(&mut training, &run, &[0, 1], "segments of both hosts after a death");
    }
    cut(&hosts, &mut training, &run, 60);
    let (carried, lost) = hosts.counts();
    assert!(lost > 0 && carried > lost, "{carried} packets carried, {lost} lost");
    training.signal_group(Signal::INT);
    training.wait().with_status(130).saying("checkpoint written");
    let last = rows(&run, "metrics.jsonl").pop().unwrap();
    assert_eq!(last["lost"], 0, "{last}");
    for bridge in bridges {
        bridge.signal_group(Signal::INT);
        bridge.wait().with_status(130);
    }
    place.until_no_process();
    assert!(shared_memory_of(&run).is_empty());
}

/// Cuts the second of the other hosts off for this time, while the run continues with the first.
fn cut(hosts: &Hosts, training: &mut Running, run: &str, seconds: u64) {
    hosts.cut(2, true);
    let began = Instant::now();
    until_more(training, run, &[0], "segments of the host that is not cut off");
    training.until("the end of the cut", |_| began.elapsed() >= Duration::from_secs(seconds));
    hosts.cut(2, false);
    until_more(training, run, &[1], "segments of the host that was cut off");
}

/// The examples of the documentation, unchanged.
#[test]
fn with_mutual_tls_a_host_takes_part_whose_certificate_is_named_and_no_other() {
    let Some(hosts) = three_hosts(2) else { return };
    let place = Workplace::new();
    let examples = project_root().join("docs/examples/several-hosts");
    let learner = hosts.address(0).to_string();
    let made = Command::new(examples.join("certificates.sh"))
        .arg(place.folder())
        .args([&learner, "host-a", "host-c"])
        .output()
        .expect("bash runs the example");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    for file in ["zenoh-learner.json5", "zenoh-host.json5"] {
        fs::copy(examples.join(file), place.folder().join(file)).unwrap();
    }
    let other = fs::read_to_string(examples.join("zenoh-host.json5")).unwrap();
    fs::write(place.path("other.json5"), other.replace("host-a", "host-c")).unwrap();

    let run = place.path("run");
    let endpoint = format!("tls/{learner}:{PORT}");
    let listen = format!("bridge.listen=[\"{endpoint}\"]");
    let open = ["--workers", "1", "--set", &listen];
    let secured = ["--set", "bridge.zenoh_file=zenoh-learner.json5", "--steps", ENDLESS];
    let arguments = [&open[..], &secured].concat();
    let mut training = start(&place, &hosts, 0, &train("reacher", &run, &arguments));
    let token = format!("{run}/bridge.token");
    training.until("a token", |_| Path::new(&token).is_file());
    let (near, far) = (place.path("near"), place.path("far"));
    let mut strangers = [
        // Signed by the authority, but not named.
        [&bridge_arguments(&token, &endpoint, "c", &far)[..], &["--zenoh-config", "other.json5"]]
            .concat(),
        // Without any certificate.
        bridge_arguments(&token, &endpoint, "d", &far),
    ]
    .map(|arguments| start(&place, &hosts, 2, &arguments));
    let named = bridge_arguments(&token, &endpoint, "a", &near);
    let named = [&named[..], &["--zenoh-config", "zenoh-host.json5"]].concat();
    let bridge = start(&place, &hosts, 1, &named);
    until_more(&mut training, &run, &[0], "segments of the host that is named");
    for stranger in &mut strangers {
        stranger.until_said("no learner's host with this token answers");
    }
    assert!(!training.said().contains("host c") && !training.said().contains("host d"));
    training.signal_group(Signal::INT);
    training.wait().with_status(130);
    drop((bridge, strangers));
}
