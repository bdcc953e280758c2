//! Configuration of the policy: its kind, its DMP and its inverse controller.

use std::str::FromStr;

#[cfg(feature = "schema")]
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the phase x of the canonical system advances.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum CanonicalIntegration {
    /// Explicit Euler; x is advanced before the basis is evaluated, so that with the default values
    /// the first evaluation is at x_1 = 0.975.
    Euler,
    /// The exact exponential exp(-alpha_x t / tau).
    Exact,
}

/// Widths h_i of the Gaussian basis functions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum BasisWidths {
    /// h_i = N^1.5 / (c_i alpha_x), as in Neural Dynamic Policies.
    Ndp,
    /// Each basis function is 0.8 at the next centre: h_i = -ln(0.8) / (c_{i+1} - c_i)^2. The last
    /// width equals the one before it.
    Overlap,
}

/// Factor on the forcing term.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ForcingScaling {
    /// No factor (the paper's equation 9).
    None,
    /// g - y0, as in Neural Dynamic Policies.
    Goal,
}

/// How the transformation system is integrated over a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Integrator {
    /// yd first, then y with the new yd.
    SemiImplicit,
    /// y with the old yd, then yd (Neural Dynamic Policies).
    Explicit,
    /// The paper's equation 14 as printed: the acceleration acts one step late, ydd_0 = 0.
    Paper,
}

impl Integrator {
    /// Stability limit of `alpha_y` at the step `dt` = tau / integration_steps, with tau = 1.
    ///
    /// The unforced system decays if and only if `alpha_y` is below the limit. Let
    /// a = omega dt = alpha_y dt / 2. All roots of the step's characteristic polynomial are inside
    /// the unit circle (Jury's criterion) under these conditions:
    /// - `explicit`: (z - 1 + a)^2; a < 2.
    /// - `semi_implicit`: z^2 - (2 - 2a - a^2) z + 1 - 2a; a^2 + 4a < 4, so a < 2 sqrt(2) - 2.
    /// - `paper`: z^3 - 2z^2 + (1 + 2a) z + a^2 - 2a; a^3 - 4a^2 + 6a < 2, so a < 0.456.
    ///
    /// At dt = 0.025: 160, 66.27 and 36.51.
    #[must_use]
    pub fn alpha_y_max(self, dt: f64) -> f64 {
        let a = match self {
            // Cardano's root of the cubic.
            Self::Paper => {
                let root = 297.0_f64.sqrt();
                (4.0 + (root - 17.0).cbrt() - (root + 17.0).cbrt()) / 3.0
            }
            Self::SemiImplicit => 2.0 * 2.0_f64.sqrt() - 2.0,
            Self::Explicit => 2.0,
        };
        2.0 * a / dt
    }
}

/// The dynamic movement primitive, one per action dimension.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct DmpConfig {
    /// Number of basis functions N. More basis functions allow more detailed motions.
    pub basis_count: usize,
    /// Decay of the phase, alpha_x. Larger values make the forcing term fade sooner.
    pub alpha_x: f64,
    /// Stiffness of the transformation system; beta_y = alpha_y / 4 (critically damped). With a
    /// larger value the motion reaches its goal sooner. Values for which the integrator is unstable
    /// are rejected.
    pub alpha_y: f64,
    /// Integration steps m over one segment; a multiple of `policy.segment_steps`.
    pub integration_steps: usize,
    /// How the transformation system is integrated.
    pub integrator: Integrator,
    /// How the phase is integrated.
    pub canonical: CanonicalIntegration,
    /// Widths of the basis functions.
    pub widths: BasisWidths,
    /// Factor on the forcing term.
    pub forcing_scaling: ForcingScaling,
}

impl Default for DmpConfig {
    fn default() -> Self {
        Self {
            basis_count: 5,
            alpha_x: 1.0,
            alpha_y: 10.0,
            integration_steps: 40,
            integrator: Integrator::SemiImplicit,
            canonical: CanonicalIntegration::Euler,
            widths: BasisWidths::Ndp,
            forcing_scaling: ForcingScaling::None,
        }
    }
}

/// Kind of policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum PolicyKind {
    /// A network that outputs DMP and inverse-controller parameters for a segment.
    Dmp,
    /// A network that outputs one action; it decides at every environment step.
    Mlp,
    /// A network that outputs the actions of a segment. It has everything that `dmp` has except the
    /// movement primitive and its controller, so a comparison shows their share.
    Chunk,
}

impl PolicyKind {
    /// The kind's name in a configuration.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Dmp => "dmp",
            Self::Mlp => "mlp",
            Self::Chunk => "chunk",
        }
    }
}

/// Bounds of the inverse controller's parameters rho.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum RhoKind {
    /// rho = (1, 0, 0, 0) + rho_range * tanh(.).
    Bounded,
    /// rho = (1, 0, 0, 0) + the network's raw output. Actions saturate, and learning is worse.
    Free,
}

/// Controller that converts the DMP's motion into actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Controller {
    /// The adaptive inverse controller, with rho from the network.
    Inverse,
    /// Successive differences of y, times `position_scale` (Neural Dynamic Policies). These actions
    /// are unbounded, so only algorithms that clip actions accept this controller.
    Position,
    /// u = tanh(y), without a controller. With `start = "action"` the actions are continuous. A
    /// goal at the bound of `goal_range` = 1 holds |u| = 0.76, of 2 it holds 0.96.
    Direct,
}

/// Initial state of a segment's DMP.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// y = yd = 0 at the start of every segment.
    Zero,
    /// y0 and yd0 are read from the observation, at the entries in `task.start_sources`.
    Observed,
    /// y and yd continue from the end of the previous segment; they are zero after a reset.
    Carry,
    /// y0 is tanh⁻¹ of the last action, and yd0 is its change in the last step; both are zero after
    /// a reset. Networks see them as part of the observation, those of `mlp` and `chunk` too.
    Action,
}

/// Source of yd0 for `start = "observed"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum StartVelocity {
    /// The measured velocity, converted to DMP time.
    Measured,
    /// Zero, as in the paper.
    Zero,
}

/// How a policy acts without exploration. Training workers always execute whole segments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Execution {
    /// Decides once per segment and executes all of its actions.
    Segment,
    /// Decides at every step. The action is the mean of the new segment's first action and of the
    /// one that was planned for this step; the rest of the plan is blended in the same way
    /// (temporal ensembling, Zhao et al. 2023). The motion is smoother and sees every observation.
    Ensemble,
}

impl Execution {
    /// The name in a configuration.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Segment => "segment",
            Self::Ensemble => "ensemble",
        }
    }

    /// The execution of policies that are older than this key.
    fn of_older_files() -> Self {
        Self::Segment
    }
}

impl FromStr for Execution {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let known = [Self::Segment, Self::Ensemble];
        known
            .into_iter()
            .find(|execution| execution.name() == name)
            .ok_or_else(|| "expected segment or ensemble".to_owned())
    }
}

/// Entries of an observation from which one action dimension's y0 and yd0 are read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(untagged, deny_unknown_fields)]
pub enum StartSource {
    /// y0 = atan2(observation\[sin\], observation\[cos\]).
    Angle {
        /// Index of the cosine.
        cos: usize,
        /// Index of the sine.
        sin: usize,
        /// Index of the angular velocity [rad/s].
        velocity: usize,
    },
    /// y0 = scale * observation\[index\], yd0 from observation\[velocity\].
    Value {
        /// Index of the position.
        index: usize,
        /// Index of the velocity.
        velocity: usize,
        /// Factor on the position; -1 where the observation is goal minus position.
        #[serde(default = "unit_scale")]
        scale: f32,
    },
}

impl StartSource {
    /// Returns the index of the velocity.
    #[must_use]
    pub fn velocity(&self) -> usize {
        match self {
            Self::Angle { velocity, .. } | Self::Value { velocity, .. } => *velocity,
        }
    }
}

fn unit_scale() -> f32 {
    1.0
}

/// The policy, which maps an observation to the actions of a segment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct PolicyConfig {
    /// Kind of policy.
    pub kind: PolicyKind,
    /// Environment steps K per decision. Ignored by `mlp`, which decides at every step.
    pub segment_steps: usize,
    /// How evaluations and robots execute segments. Ignored by `mlp`.
    #[serde(default = "Execution::of_older_files")]
    pub execution: Execution,
    /// Widths of the actor's hidden layers.
    pub hidden: Vec<usize>,
    /// Whether observations are normalised to zero mean and unit scale before they enter the
    /// networks. Normalisation starts at the end of the warm-up. Its statistics are folded into
    /// published policies.
    pub normalise_observations: bool,
    /// Share of each action's range, around its middle, that the policy uses. Smaller actions make
    /// a robot slower and its contacts gentler.
    pub action_range: f64,
    /// Bound of the goal: g = goal_range * tanh(.).
    pub goal_range: f64,
    /// Bound of the weights: w = weight_range * omega^2 * tanh(.), omega = alpha_y / 2.
    pub weight_range: f64,
    /// Controller that converts the DMP's motion into actions.
    pub controller: Controller,
    /// Scaled action u per unit of motion in y, for `controller = "position"`.
    pub position_scale: f64,
    /// Whether rho is bounded.
    pub rho: RhoKind,
    /// Half-width of rho around (1, 0, 0, 0) when bounded.
    pub rho_range: f64,
    /// Initial state of a segment's DMP.
    pub start: Start,
    /// Source of yd0 for `start = "observed"`.
    pub start_velocity: StartVelocity,
}

impl Default for PolicyConfig {
    fn default() -> Self {
        Self {
            kind: PolicyKind::Dmp,
            segment_steps: 5,
            execution: Execution::Ensemble,
            hidden: vec![256, 256],
            normalise_observations: true,
            action_range: 1.0,
            goal_range: 1.0,
            weight_range: 1.0,
            controller: Controller::Inverse,
            position_scale: 1.0,
            rho: RhoKind::Bounded,
            rho_range: 2.0,
            start: Start::Zero,
            start_velocity: StartVelocity::Measured,
        }
    }
}

impl PolicyConfig {
    /// Returns the environment steps of one decision: K for `dmp` and `chunk`, 1 for `mlp`.
    #[must_use]
    pub fn decision_steps(&self) -> usize {
        match self.kind {
            PolicyKind::Dmp | PolicyKind::Chunk => self.segment_steps,
            PolicyKind::Mlp => 1,
        }
    }

    /// Returns whether the policy blends segments when it does not explore.
    #[must_use]
    pub fn is_ensemble(&self) -> bool {
        self.execution == Execution::Ensemble && self.decision_steps() > 1
    }

    /// Returns the steps between two decisions without exploration: 1 for an ensemble.
    #[must_use]
    pub fn execution_steps(&self) -> usize {
        if self.is_ensemble() { 1 } else { self.decision_steps() }
    }

    /// Returns the length of the state (y, yd) that follows the environment's observation: 2A or 0.
    #[must_use]
    pub fn state_len(&self, action_len: usize) -> usize {
        let has_state = self.follows_actions() || self.carries_dmp_state();
        if has_state { 2 * action_len } else { 0 }
    }

    /// Returns whether the observation contains the last action and its change.
    #[must_use]
    pub fn follows_actions(&self) -> bool {
        self.start == Start::Action
    }

    /// Returns whether the observation contains the DMP's own state.
    #[must_use]
    pub fn carries_dmp_state(&self) -> bool {
        self.kind == PolicyKind::Dmp && self.start == Start::Carry
    }
}
