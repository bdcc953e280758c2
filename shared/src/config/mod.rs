//! Stage 1 of 8: the typed configuration of an experiment and its defaults.
//!
//! Precedence, lowest first: task defaults, preset, the task's values for that preset, file,
//! environment variables, `--set` and flags.
//! `layers` merges them as TOML tables. It rejects unknown keys and suggests the nearest known one.
//! `resolve` fills in values that depend on others and checks all of them. Every default of the
//! system is in this folder or, for policies, in `dmprl_runtime::config`.

mod algorithm;
pub mod endpoint;
mod experiment;
mod layers;
mod learner;
mod presets;
mod randomise;
mod resolve;
mod task;
mod tasks;

pub use algorithm::{
    AfterTimeLimit, AlgorithmConfig, CriticInput, ExplorationConfig, ExplorationKind,
    LearningRateDecay, NdpConfig, SacConfig, Target, Td3Config, TqcConfig, WarmUpKind, Windows,
};
pub use dmprl_runtime::config::{
    AlgorithmName, BasisWidths, CanonicalIntegration, Controller, DmpConfig, Execution,
    ForcingScaling, Integrator, PolicyConfig, PolicyKind, RangeError, RhoKind, Start, StartSource,
    StartVelocity,
};
use dmprl_runtime::config::{check_hidden, range};
pub use experiment::{
    ActorsConfig, BridgeConfig, CheckpointConfig, DeliveryConfig, DeliveryLevel,
    DemonstrationsConfig, EvaluationConfig, ExperimentConfig, Hindsight, MetricsConfig,
    PacingConfig, ReplayConfig, RunConfig, SupervisionConfig,
};
pub use layers::{ConfigError, Layers, nearest};
pub use learner::{Backend, Device, LearnerConfig, Precision};
pub use presets::{PRESETS, Preset, algorithm_defaults, policy_defaults, suitable_preset};
pub use randomise::RandomiseConfig;
pub use resolve::Limits;
pub use task::{TaskConfig, is_python_object};
pub use tasks::{TASKS, TaskDefaults, task_defaults};
