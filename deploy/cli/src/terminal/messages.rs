//! Writes messages on standard error: text for people, JSON with `--events json`, and text with
//! the time in a role's log.
//!
//! The crates below this one log with `tracing`. [`install`] makes this module the subscriber.

use std::fmt::{Debug, Write as _};
use std::io::Write as _;
use std::sync::OnceLock;

use dmprl_run::now_rfc3339;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::registry;

use super::events;

/// Prefix of the targets of our own crates. Messages of other libraries are not shown.
const OWN_TARGETS: &str = "dmprl";

/// Format of the messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageStyle {
    /// Lines for people.
    Text,
    /// Events of the kind `message`: with `--events json`, every line on standard error is JSON.
    Json,
    /// Lines with the time, for the log file of a role.
    Log,
}

static STYLE: OnceLock<MessageStyle> = OnceLock::new();

/// Shows the messages of all our crates in this style. Called once, before the command runs.
pub fn install(style: MessageStyle) {
    // A second call, as in tests, has no effect.
    if STYLE.set(style).is_ok() {
        let _ = tracing::subscriber::set_global_default(registry().with(Messages));
    }
}

/// Returns true if standard error is for JSON.
#[must_use]
pub fn says_json() -> bool {
    style() == MessageStyle::Json
}

/// Shows a command's text, such as a suggestion of the next command.
pub fn say(text: &str) {
    show(Level::INFO, text);
}

/// Prints a line on standard error as it is. Unlike `eprintln!` it does not panic if writing fails,
/// for instance after a terminal was closed or on a full disk.
pub fn write_line(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Shows the error that ends the program.
pub fn show_error(text: &str) {
    match style() {
        MessageStyle::Text => write_line(text),
        MessageStyle::Json => write_line(&events::error(text)),
        MessageStyle::Log => write_line(&format!("{} {text}", now_rfc3339())),
    }
}

fn style() -> MessageStyle {
    STYLE.get().copied().unwrap_or(MessageStyle::Text)
}

fn show(level: Level, text: &str) {
    let prefix = match level {
        Level::ERROR => "error: ",
        Level::WARN => "warning: ",
        _ => "",
    };
    match style() {
        MessageStyle::Text => write_line(&format!("{prefix}{text}")),
        MessageStyle::Json => write_line(&events::message(&format!("{prefix}{text}"))),
        MessageStyle::Log => write_line(&format!("{} {prefix}{text}", now_rfc3339())),
    }
}

/// Shows the events of our crates.
struct Messages;

impl<S: Subscriber> Layer<S> for Messages {
    fn enabled(&self, metadata: &Metadata<'_>, _context: Context<'_, S>) -> bool {
        metadata.target().starts_with(OWN_TARGETS) && *metadata.level() <= Level::INFO
    }

    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut text = Text::default();
        event.record(&mut text);
        show(*event.metadata().level(), &(text.message + &text.fields));
    }
}

/// The text of an event: its message, then ` key=value` for each other field.
#[derive(Default)]
struct Text {
    message: String,
    fields: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // Writing into a string does not fail.
        let _ = if field.name() == "message" {
            write!(self.message, "{value:?}")
        } else {
            write!(self.fields, " {}={value:?}", field.name())
        };
    }
}
