//! Stage 8 of 8: draws the pictures of runs and reports.

mod axes;
mod colours;
mod learning_curve;
mod panels;
mod png;
mod scatter;
mod small_multiples;

pub(crate) use axes::{Axes, Chart};
pub(crate) use colours::palette;
pub use colours::{colour, has_colour};
pub use learning_curve::learning_curve;
pub(crate) use png::png;
pub(crate) use scatter::{Bounded, Scatter, ScatterPanel, ScatterPoint};
pub(crate) use small_multiples::{Panel, SmallMultiples};
