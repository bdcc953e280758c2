//! `dmprl play` as a page, because a test has no display.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use dmprl_tests::program::{Running, Workplace};
use rustix::process::Signal;

use super::record::can_draw;
use crate::train;

/// Longer than any frame takes.
const PATIENCE: Duration = Duration::from_secs(60);

/// Sends the head of a request; the answer is read later.
fn ask(port: &str, path: &str, host: &str) -> (String, BufReader<TcpStream>) {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n").unwrap();
    let mut reader = BufReader::new(stream);
    (head(&mut reader), reader)
}

/// Reads lines up to an empty one.
fn head(reader: &mut BufReader<TcpStream>) -> String {
    let mut text = String::new();
    while !text.ends_with("\r\n\r\n") {
        assert!(reader.read_line(&mut text).unwrap() > 0, "it hung up after {text:?}");
    }
    text
}

/// Reads the next picture of a stream.
fn picture(reader: &mut BufReader<TcpStream>) -> Vec<u8> {
    let head = head(reader);
    let length = head.split("Content-Length: ").nth(1).unwrap().trim().parse().unwrap();
    let mut picture = vec![0; length];
    reader.read_exact(&mut picture).unwrap();
    let mut end = [0; 2];
    reader.read_exact(&mut end).unwrap();
    picture
}

fn port(playing: &mut Running) -> String {
    playing.until("an address", |playing| playing.printed().contains("http://"));
    playing.printed().trim().trim_end_matches('/').rsplit(':').next().unwrap().to_owned()
}

#[test]
fn a_browser_sees_the_episode_move_until_it_is_stopped() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    if !can_draw() {
        return;
    }
    let mut playing = place.start(&["play", &run, "--stream", "--port", "0"]);
    let port = port(&mut playing);
    let (answer, mut page) = ask(&port, "/", "127.0.0.1");
    assert!(answer.starts_with("HTTP/1.0 200"), "{answer}");
    let mut text = String::new();
    page.read_to_string(&mut text).unwrap();
    assert!(text.contains("reacher") && text.contains("src=\"stream\""), "{text}");

    let (answer, mut stream) = ask(&port, "/stream", "localhost:1");
    assert!(answer.contains("multipart/x-mixed-replace"), "{answer}");
    let pictures: Vec<_> = (0..5).map(|_| picture(&mut stream)).collect();
    assert!(pictures.iter().all(|picture| picture.starts_with(&[0xff, 0xd8])), "no JPEG");
    assert!(pictures.windows(2).any(|pair| pair[0] != pair[1]), "nothing moves");

    // A site whose host name resolves to this machine gets nothing.
    assert!(ask(&port, "/stream", "example.org").0.starts_with("HTTP/1.0 403"));
    assert!(ask(&port, "/else", "127.0.0.1").0.starts_with("HTTP/1.0 404"));
    playing.signal(Signal::INT);
    playing.wait().with_status(130);
    place.until_no_process();
}

#[test]
fn episodes_that_are_over_end_it_and_a_kill_leaves_nobody() {
    let place = Workplace::new();
    let run = place.path("run");
    place.run(&train("reacher", &run, &["--steps", "1000"])).with_status(0);
    if !can_draw() {
        return;
    }
    let arguments = ["play", &run, "--stream", "--port", "0", "--episodes", "1", "--seed", "7"];
    let ended = place.run(&arguments).with_status(0);
    assert!(ended.printed.contains("seed 7: return -"), "{}", ended.printed);
    let mut playing = place.start(&["play", &run, "--stream", "--port", "0"]);
    port(&mut playing);
    playing.signal(Signal::KILL);
    playing.wait();
    place.until_no_process();
    let folder = dmprl_tests::project_root().join("docs/examples");
    let more = ["--steps", "1000", "--python-path", folder.to_str().unwrap()];
    let own = place.path("own");
    place.run(&train("point_reach:PointReach-v0", &own, &more)).with_status(0);
    let refused = place.run(&["play", &own, "--stream", "--port", "0"]).with_status(1);
    refused.saying("cannot be shown").saying("rgb_array");
}
