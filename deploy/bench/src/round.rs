//! The result of one round of `bench rollout`.

/// Rate and load of one candidate in one round.
#[derive(Debug, Clone, Copy)]
pub(super) struct Round {
    /// Environment steps per second of all processes.
    pub(super) steps_per_s: f64,
    /// Number of cores used (processor time divided by wall time), if the system reports it.
    pub(super) cores: Option<f64>,
}
