//! Runs `dmprl bench transport` between two network namespaces, on a wire with delay and loss;
//! docs/benchmarks.md has its figures. Needs root.
//!
//!     cargo run --release --package dmprl-tests --example namespaces -- \
//!         [tcp|tls] MS LOSS SECONDS WORKERS [RATE]
//!
//! The protocol is `tcp` by default. MS: delay each way in milliseconds. WORKERS: 0 measures
//! policies alone. RATE: total segments per second; unlimited without it.
//!
//! Prints the JSON of both ends, one line each, and the numbers of packets.

use std::process::{Command, ExitCode, Stdio};
use std::time::Duration;

use dmprl_tests::hosts::Hosts;
use dmprl_tests::program::executable;

/// Maximum size of a connection's buffers: several times rate × round trip.
const TCP_BYTES_MAX: usize = 128 << 20;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let protocol = arguments.first().filter(|word| ["tcp", "tls"].contains(&word.as_str()));
    let numbers: Vec<f64> = arguments.iter().filter_map(|number| number.parse().ok()).collect();
    let [delay_ms, loss, seconds, workers, ref rate @ ..] = numbers[..] else {
        eprintln!(
            "usage: namespaces [tcp|tls] MILLISECONDS_EACH_WAY SHARE_LOST SECONDS WORKERS [RATE]"
        );
        return ExitCode::from(2);
    };
    let hosts = match Hosts::new(2, TCP_BYTES_MAX, 1) {
        Ok(hosts) => hosts,
        Err(error) => {
            eprintln!("network namespaces and TUN devices need root: {error}");
            return ExitCode::FAILURE;
        }
    };
    hosts.delay(Duration::from_secs_f64(delay_ms / 1e3));
    hosts.lose(loss);
    let protocol = protocol.map_or("tcp", String::as_str);
    let endpoint = format!("{protocol}/{}:7448", hosts.address(0));
    let (seconds, workers) = (seconds.to_string(), workers.to_string());
    let mut there = vec!["--connect".to_owned(), endpoint.clone(), "--workers".into(), workers];
    there.extend(rate.iter().flat_map(|rate| ["--rate".to_owned(), rate.to_string()]));
    let ends = [vec!["--listen".to_owned(), endpoint, "--seconds".into(), seconds], there];
    let started = ends.into_iter().enumerate().map(|(host, end)| {
        let mut command = Command::new(executable());
        command.args(["bench", "transport", "--json"]).args(end).stdout(Stdio::piped());
        hosts.place(host, &mut command);
        command.spawn().expect("dmprl starts")
    });
    let mut all_well = true;
    for end in started.collect::<Vec<_>>() {
        let output = end.wait_with_output().expect("an end can be waited for");
        all_well &= output.status.success();
        print!("{}", String::from_utf8_lossy(&output.stdout));
    }
    let (carried, lost) = hosts.counts();
    println!("{{\"delay_ms\":{delay_ms},\"packets\":{carried},\"packets_lost\":{lost}}}");
    if all_well { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
