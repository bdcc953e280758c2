//! Sets the path of libpython in the executables of this crate.
//!
//! `actors/build.rs` asks the interpreter; its answer arrives in the environment because
//! `dmprl-actors` has a `links` key.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // Absent without the feature `python`.
    if let Ok(link_arg) = std::env::var("DEP_DMPRL_PYTHON_LINK_ARG") {
        println!("cargo::rustc-link-arg={link_arg}");
    }
}
