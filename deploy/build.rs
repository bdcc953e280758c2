//! Lets this crate's executables find libpython where the linked interpreter keeps it.
//!
//! `actors/build.rs` asked the interpreter; its answer arrives in the environment because
//! `dmprl-actors` has a `links` key.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // Absent without the feature `python`.
    if let Ok(link_arg) = std::env::var("DEP_DMPRL_PYTHON_LINK_ARG") {
        println!("cargo::rustc-link-arg={link_arg}");
    }
}
