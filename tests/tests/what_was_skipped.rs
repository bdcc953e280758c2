//! Ends a test run with the list of what was skipped.
//!
//! Not a test: cargo runs the members in the order of their names and each one's tests likewise, so
//! this target is the last (`tidy.rs` checks that it is), and without libtest's harness its output
//! is shown. Cargo does not come here after a failure.

fn main() {
    // Asked by `cargo test -- --list` and other runners for its tests: it has none.
    if !std::env::args().any(|argument| argument == "--list") {
        dmprl_tests::skip_list::print();
    }
}
