//! Rolls saved policies out in observer processes: records videos of their episodes, and measures
//! their motion.
//!
//! For a video of one run, or of two side by side, an observer for each run renders the episodes.
//! Then `envs_py/dmprl/film.py` makes video, animation and filmstrip from the frames, by the plan
//! that `film_plan` writes. All files are created in a temporary folder next to the output, and
//! moved when they are complete. `motion` renders nothing and hands the episodes to
//! [`dmprl_analysis::motion`]. The commands `record` and `report` call it.

mod film_plan;
mod motion;
mod observer;
mod video;

pub use motion::measure_motion;
pub use observer::Observer;
pub use video::{RecordPlan, Recordings, SideRecord, record};
