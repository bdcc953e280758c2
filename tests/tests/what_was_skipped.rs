//! Prints the list of skipped tests at the end of a test run.
//!
//! Not a test. Cargo runs the members in the order of their names, and each one's tests likewise,
//! so this target is the last (`tidy/main.rs` checks this). It does not use libtest's harness, so
//! its output is shown. Cargo does not run it after a failure.

fn main() {
    // `cargo test -- --list` and other runners ask for its tests: it has none.
    if !std::env::args().any(|argument| argument == "--list") {
        dmprl_tests::skip_list::print();
    }
}
