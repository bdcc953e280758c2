//! Stages 3 and 6 of 8: dynamic movement primitives, which map a decision (g, w, rho) to the
//! actions of a segment.
//!
//! `policy` calls this module once per action dimension. "The paper" is "Efficient Robot
//! Manipulation via Reinforcement Learning with Dynamic Movement Primitives-Based Policy" (Appl.
//! Sci. 2024, 14, 10665), equations 8 to 14. Each item documents its differences from the paper and
//! its reading of ambiguous passages.
//!
//! | symbol | meaning | unit (DMP time, tau = 1) |
//! |---|---|---|
//! | y, yd, ydd | position, velocity, acceleration of the transformation system | u, u/s, u/s^2 |
//! | y0, yd0 | state at the start of a segment | u, u/s |
//! | g | goal, the point to which the system converges | u |
//! | w (w_i) | weights of the forcing term, one per basis function | u/s^2 |
//! | f | forcing term | u/s^2 |
//! | x (x_j) | phase, from 1 towards 0; x_j after j steps | 1 |
//! | psi (psi_i) | Gaussian basis functions of the phase | 1 |
//! | c, h (c_i, h_i) | their centres and widths: psi = exp(-h (x - c)^2) | 1 |
//! | phi (phi_i) | x psi_i / sum psi, the factor of w_i | 1 |
//! | tau | duration of the movement | s |
//! | alpha_x | decay of the phase | 1 |
//! | alpha_y, beta_y | stiffness of the transformation system; beta_y = alpha_y / 4 | 1 |
//! | omega | alpha_y / 2, its natural frequency (critically damped) | 1/s |
//! | rho | the inverse controller's four parameters | 1 |
//! | K, m, N | samples of a segment, integration steps, basis functions | |
//!
//! "u" is the unit of y (an angle, a torque as a fraction of its bound, ...).
//!
//! There are two implementations. [`Dmp::integrate`] steps the differential equation and is the
//! reference. [`SegmentMap`] is used in production: a segment is an affine map of (y0, yd0, g, w)
//! with constant coefficients, so it is one small matrix product, whose gradient is the product
//! with the transposed matrix. Tests compare the two.

mod affine;
mod basis;
mod canonical;
mod error;
mod forcing;
mod imitation;
mod inverse_controller;
mod least_squares;
mod primitive;
mod transformation;

#[cfg(test)]
mod affine_tests;
#[cfg(test)]
mod convergence_tests;
#[cfg(test)]
mod golden_tests;
#[cfg(test)]
mod segment_tests;
#[cfg(test)]
mod test_support;

pub use affine::SegmentMap;
pub use basis::Basis;
pub use canonical::CanonicalSystem;
pub use error::DmpError;
pub use forcing::{feature_matrix, features, forcing, forcing_factor};
pub use imitation::{Imitation, fit_weights, imitate};
pub use inverse_controller::{act, act_backward, act_position, act_position_backward};
pub use primitive::{Dmp, STATE_INPUTS};
pub use transformation::{Real, Sample, State, Trajectory, TransformationSystem};
