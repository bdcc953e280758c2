//! The part of an experiment's configuration that a policy is built from.

mod algorithm_name;
mod dmp;
mod policy_check;
mod range;

pub use algorithm_name::AlgorithmName;
pub use dmp::{
    BasisWidths, CanonicalIntegration, Controller, DmpConfig, Execution, ForcingScaling,
    Integrator, PolicyConfig, PolicyKind, RhoKind, Start, StartSource, StartVelocity,
};
pub use policy_check::check_hidden;
pub use range::{RangeError, range};
