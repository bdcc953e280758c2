//! Handles a call into the environments that hangs.

use dmprl_control::{ControlPipe, Report};
use dmprl_run::ENV_HUNG_STATUS;
use tracing::error;

/// Returns a handler that reports the hang and exits, so that the supervisor starts a new process.
pub fn on_hang(control: &ControlPipe) -> impl FnOnce(String) + Send + 'static {
    let reporter = control.reporter();
    move |message| {
        error!("{message}");
        // Exit even if the supervisor is gone.
        let _ = reporter.send(&Report::EnvHung { message });
        // SAFETY: `_exit` takes a number and does not return. Handlers and destructors that `exit`
        // runs would wait for the hanging thread.
        unsafe { libc::_exit(ENV_HUNG_STATUS) }
    }
}
