//! Rolls saved policies out in observer processes: records videos of their episodes, and measures
//! their motion.
//!
//! A video shows one run, or two side by side. An observer for each run renders the episodes. Then
//! `envs_py/dmprl/film.py` makes the video, an animation and a filmstrip from the frames, as
//! described by the plan that `film_plan` writes, and `envs_py/dmprl/rerun_log.py` a Rerun log, as
//! described by that of `rerun_plan`. All files are created in a temporary folder in
//! the output directory, and moved when they are complete. `motion` renders nothing and passes the
//! episodes to [`dmprl_analysis::motion`]. The commands `record` and `report` call this module.

mod film_plan;
mod motion;
mod observer;
mod rerun_plan;
mod video;

pub use motion::measure_motion;
pub use observer::Observer;
pub use video::{RecordPlan, Recordings, SideRecord, record};
