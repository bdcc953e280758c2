//! One measurement of `bench rollout`.

/// One measurement.
#[derive(Debug, Clone, Copy)]
pub(super) struct Round {
    /// Environment steps per second of all processes.
    pub(super) steps_per_s: f64,
    /// Processor time divided by wall time, that is, the number of cores really used, if the system
    /// reports it.
    pub(super) cores: Option<f64>,
}
