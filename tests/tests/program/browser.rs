//! A headless Chromium, driven by its DevTools protocol over two pipes: JSON objects, each followed
//! by a zero byte. No port, no driver program, no WebSocket.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io::{BufRead, BufReader, PipeReader, PipeWriter, Write};
use std::os::fd::AsRawFd;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Instant;

use dmprl_tests::program::{PATIENCE, until};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Names of the program on different systems.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
/// File descriptors of the protocol in the browser.
const ENDS: [i32; 2] = [3, 4];

/// A browser with one page. Dropping it kills the browser.
pub struct Browser {
    child: Child,
    commands: RefCell<PipeWriter>,
    answers: Receiver<Value>,
    session: String,
    number: Cell<u64>,
    /// Complaints of the page and the browser.
    complaints: RefCell<VecDeque<String>>,
    _profile: TempDir,
}

/// Returns the browser of this machine, by `TEST_CHROMIUM` or by name.
pub fn find() -> Option<PathBuf> {
    if let Some(named) = std::env::var_os("TEST_CHROMIUM") {
        return Some(named.into());
    }
    let folders = std::env::var_os("PATH")?;
    let places = std::env::split_paths(&folders)
        .flat_map(|folder| NAMES.map(|name| folder.join(name)))
        .collect::<Vec<_>>();
    places.into_iter().find(|place| place.is_file())
}

impl Browser {
    pub fn start(program: PathBuf) -> Self {
        let profile = tempfile::tempdir().unwrap();
        let (their_input, commands) = std::io::pipe().unwrap();
        let (answers, their_output) = std::io::pipe().unwrap();
        let mut command = Command::new(program);
        command.args(["--headless=new", "--remote-debugging-pipe", "--no-first-run"]);
        command.args(["--disable-gpu", "--disable-dev-shm-usage", "--disable-extensions"]);
        command.args(["--disable-background-networking", "--no-default-browser-check"]);
        if rustix::process::geteuid().is_root() {
            // As root it refuses to run with its sandbox; the page is our own.
            command.arg("--no-sandbox");
        }
        command.arg(format!("--user-data-dir={}", profile.path().display())).arg("about:blank");
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        // Its helper processes end with its process group.
        command.process_group(0);
        let ends = [their_input.as_raw_fd(), their_output.as_raw_fd()];
        let give = move || {
            // Moved first: one end may have the number that the other end gets.
            // SAFETY: `fcntl` and `dup2` are async-signal-safe and take plain numbers.
            unsafe {
                let aside = ends.map(|end| libc::fcntl(end, libc::F_DUPFD_CLOEXEC, 10));
                for (end, place) in aside.into_iter().zip(ENDS) {
                    if end < 0 || libc::dup2(end, place) < 0 {
                        return Err(std::io::Error::last_os_error());
                    }
                }
            }
            Ok(())
        };
        // SAFETY: between fork and exec the closure makes system calls only and allocates nothing.
        unsafe { command.pre_exec(give) };
        let child = command.spawn().unwrap();
        let mut browser = Self {
            child,
            commands: RefCell::new(commands),
            answers: read(answers),
            session: String::new(),
            number: Cell::new(0),
            complaints: RefCell::default(),
            _profile: profile,
        };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}));
        let target = json!({"targetId": target["targetId"], "flatten": true});
        let attached = browser.call("Target.attachToTarget", target);
        browser.session = attached["sessionId"].as_str().unwrap().to_owned();
        for domain in ["Page", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser
    }

    pub fn open(&self, address: &str) {
        let opened = self.call("Page.navigate", json!({ "url": address }));
        assert!(opened["errorText"].is_null(), "{opened}");
    }

    /// Evaluates an expression in the page.
    pub fn evaluate(&self, expression: &str) -> Value {
        let params = json!({"expression": expression, "returnByValue": true});
        let answer = self.call("Runtime.evaluate", params);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn until(&self, expression: &str) {
        until(&format!("{expression}; {:?}", self.complaints), || {
            self.evaluate(expression) == Value::Bool(true)
        });
    }

    /// Clicks an element by reference. A page that is still loading moves, so a click at
    /// coordinates could miss it.
    pub fn click(&self, selector: &str) {
        self.evaluate(&format!("document.querySelector({selector:?}).click()"));
    }

    /// Sets the width of the page [CSS pixels], on a phone or not.
    pub fn resize(&self, width: u32, mobile: bool) {
        self.call(
            "Emulation.setDeviceMetricsOverride",
            json!({"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": mobile}),
        );
    }

    /// Takes the complaints of page and browser since the last call.
    pub fn complaints(&self) -> Vec<String> {
        self.complaints.borrow_mut().drain(..).collect()
    }

    pub fn call(&self, method: &str, params: Value) -> Value {
        let number = self.number.get() + 1;
        self.number.set(number);
        let mut command = json!({"id": number, "method": method, "params": params});
        if !self.session.is_empty() {
            command["sessionId"] = json!(self.session);
        }
        let mut line = serde_json::to_vec(&command).unwrap();
        line.push(0);
        self.commands.borrow_mut().write_all(&line).unwrap();
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let answer = self.answers.recv_timeout(left).unwrap_or_else(|error| {
                panic!("the browser did not answer {method}: {error}");
            });
            if answer["id"] == number {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].clone();
            }
            let event = answer["method"].as_str().unwrap_or_default();
            let params = &answer["params"];
            let is_error = event == "Log.entryAdded" && params["entry"]["level"] == "error";
            if event == "Runtime.exceptionThrown" || is_error {
                self.complaints.borrow_mut().push_back(params.to_string());
            }
        }
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let group = i32::try_from(self.child.id()).ok().and_then(rustix::process::Pid::from_raw);
        if let Some(group) = group {
            let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
        }
        let _ = self.child.wait();
    }
}

/// Reads answers and events until the browser ends.
fn read(pipe: PipeReader) -> Receiver<Value> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        for message in BufReader::new(pipe).split(0) {
            let Ok(message) = message else { return };
            let Ok(message) = serde_json::from_slice(&message) else { return };
            if sender.send(message).is_err() {
                return;
            }
        }
    });
    receiver
}
