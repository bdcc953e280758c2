//! Stage 1 of 8: the typed experiment tree, its defaults, and how a user's values reach it.
//!
//! Precedence, lowest first: task defaults, preset, file, environment variables, `--set` and flags.
//! `layers` merges them as TOML tables and rejects unknown keys with the nearest known name.
//! `resolve` turns the merged tree into checked values. This folder contains every default of the
//! system.

mod algorithm;
mod dmp;
mod experiment;
mod layers;
mod presets;
mod resolve;
mod tasks;

pub use algorithm::{
    AlgorithmConfig, AlgorithmName, CriticInput, ExplorationConfig, ExplorationKind,
    LearningRateDecay, NdpConfig, SacConfig, Target, Td3Config, WarmUpKind, Windows,
};
pub use dmp::{
    BasisWidths, CanonicalIntegration, Controller, DmpConfig, ForcingScaling, Integrator,
    PolicyConfig, PolicyKind, RhoKind, Start, StartSource, StartVelocity,
};
pub use experiment::{
    ActorsConfig, BridgeConfig, CheckpointConfig, DeliveryConfig, DeliveryLevel,
    DemonstrationsConfig, Device, EvaluationConfig, ExperimentConfig, Hindsight, LearnerConfig,
    MetricsConfig, PacingConfig, Precision, ReplayConfig, RunConfig, SupervisionConfig, TaskConfig,
};
pub use layers::{ConfigError, Layers, nearest};
pub use presets::{PRESETS, Preset, algorithm_defaults, policy_defaults};
pub use resolve::Limits;
pub use tasks::{TASKS, TaskDefaults, task_defaults};
