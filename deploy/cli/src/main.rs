//! The `dmprl` program. Everything is in the library, so that tests can use it.

use std::process::ExitCode;

fn main() -> ExitCode {
    // SAFETY: No other thread has been started.
    ExitCode::from(unsafe { dmprl::cli::main(std::env::args_os().collect()) })
}
