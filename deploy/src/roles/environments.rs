//! What a role does when a call into its environments hangs.

use super::ControlPipe;
use crate::control::{ENV_HUNG_STATUS, Report};
use crate::terminal::say;

/// Ends this process: nothing but another process could help, and the supervisor starts one.
pub fn on_hang(control: &ControlPipe) -> impl FnOnce(String) + Send + 'static {
    let reporter = control.reporter();
    move |message| {
        say(&format!("error: {message}"));
        // A supervisor that is gone changes nothing.
        let _ = reporter.send(&Report::EnvHung { message });
        // SAFETY: `_exit` takes a number and does not return. Not `exit`, whose handlers and
        // destructors would wait for the thread that hangs.
        unsafe { libc::_exit(ENV_HUNG_STATUS) }
    }
}
