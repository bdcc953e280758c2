//! The `dmprl` program. Everything is in the library, so that tests can use it.

use std::process::ExitCode;

/// candle computes the products of graphs on rayon's threads, and asks this variable for their
/// number.
const CANDLE_THREADS: &str = "RAYON_NUM_THREADS";

fn main() -> ExitCode {
    // The products of our networks are too small for several threads, and rayon's wait actively.
    if std::env::var_os(CANDLE_THREADS).is_none() {
        // SAFETY: No other thread has been started.
        unsafe { std::env::set_var(CANDLE_THREADS, "1") };
    }
    dmprl::cli::main()
}
