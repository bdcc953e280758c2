//! The `dmprl` program; everything is in the library, where tests reach it.

use std::process::ExitCode;

fn main() -> ExitCode {
    dmprl::cli::main()
}
