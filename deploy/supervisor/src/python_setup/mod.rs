//! Stage 2 of 8: creates `.venv` and installs `envs_py` into it. Every command that needs
//! environments calls it.
//!
//! The virtual environment is created with the interpreter against which the program is linked: a
//! package built for another Python may crash this one. A stamp, which is written last, records the
//! inputs of the environment. If it matches, [`ensure`] only reads a few small files. A lock file
//! serialises concurrent starts. If pip installed the program, it is in an environment already (see
//! [`Home`]).
//!
//! The package's requirements have locked versions and hashes (`envs_py/locks`). Packages that a
//! user added are on a list beside `.venv` and come back when it is recreated. An environment with
//! packages that are not on the list is renamed instead of deleted.

mod added;
mod advice;
mod command;
mod declared;
mod ensure;
mod environment;
mod extra;
mod home;
mod installed;
mod lock;
mod locks;
mod old;
mod packages;
mod paths;
mod requirement;
mod separate;
mod stamp;
mod together;
mod user_packages;

pub use self::{
    added::{Overview, add_packages, overview, remove_packages},
    ensure::{State, ensure},
    environment::PythonEnvironment,
    extra::ensure_extra,
    home::Home,
    old::OldEnvironment,
    packages::packages,
    separate::ensure_separate,
};
