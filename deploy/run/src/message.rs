//! Lines on standard error: text for people or, with `--events json`, one JSON object a line.

use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::{Map, Value, json};

/// Version of the JSON lines' format, in every line.
const FORMAT: u32 = 1;

/// Whether [`say`] writes JSON, so that `--events json` leaves no other line on standard error.
static SAYS_JSON: AtomicBool = AtomicBool::new(false);

/// Makes [`say`] write events of the kind `message` from now on.
pub fn say_json() {
    SAYS_JSON.store(true, Ordering::Relaxed);
}

/// Returns true if [`say_json`] has been called.
#[must_use]
pub fn says_json() -> bool {
    SAYS_JSON.load(Ordering::Relaxed)
}

/// Prints a line on standard error. Unlike `eprintln!` it does not panic if writing fails, for
/// instance after a terminal was closed or on a full disk.
pub fn say(text: &str) {
    if says_json() {
        write_line(&event_line("message", &json!({ "message": text })));
    } else {
        write_line(text);
    }
}

/// Prints a line on standard error as it is.
pub fn write_line(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Formats an event as one line of JSON.
///
/// - `keys`: an object with the event's own keys.
#[must_use]
pub fn event_line(kind: &str, keys: &Value) -> String {
    let mut object = Map::new();
    object.insert("format".to_owned(), json!(FORMAT));
    object.insert("event".to_owned(), json!(kind));
    if let Value::Object(keys) = keys {
        object.extend(keys.clone());
    }
    Value::Object(object).to_string()
}
