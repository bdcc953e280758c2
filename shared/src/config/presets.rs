//! Named sets of values between task defaults and the user's file.

use toml::Table;

use super::PolicyKind;

/// A preset: its name, one line about it, and its values as TOML.
#[derive(Debug)]
pub struct Preset {
    /// The name for `--preset`.
    pub name: &'static str,
    /// What it is for.
    pub about: &'static str,
    text: &'static str,
}

/// All presets, in the order `--help` lists them.
pub const PRESETS: [Preset; 2] = [
    Preset {
        name: "default",
        about: "segment critic, sliding windows, n-step target: what we measured to learn best",
        text: "",
    },
    Preset {
        name: "paper",
        about: "the paper to the letter: first-action critic, literal target, Table 2",
        text: PAPER,
    },
];

// Table 2 of the paper and section 4 of the specification. `discount` and the step sizes of the
// Panda tasks are task defaults.
const PAPER: &str = r#"
[policy]
start = "observed"
start_velocity = "zero"
[dmp]
alpha_y = 25.0
integrator = "paper"
forcing_scaling = "none"
[algorithm]
critic = "first"
windows = "segment"
target = "literal"
[exploration]
kind = "gaussian"
std = 0.1
warm_up_steps = 10000
warm_up_range = 1.0
[pacing]
updates_per_segment = 1.0
[actors]
workers = 1
envs_per_worker = 1
"#;

/// What differs from the defaults for a kind of policy, below every other layer.
///
/// `mlp` decides every step, so two updates a decision would be ten times as many as `dmp` does;
/// the baselines of the paper do one a step.
///
/// # Panics
/// Never: a test parses it.
#[must_use]
pub fn policy_defaults(kind: PolicyKind) -> Option<Table> {
    match kind {
        PolicyKind::Dmp => None,
        PolicyKind::Mlp => {
            let text = "[pacing]\nupdates_per_segment = 1.0";
            Some(text.parse().expect("the built-in defaults are valid TOML"))
        }
    }
}

impl Preset {
    /// The preset's values.
    ///
    /// # Panics
    /// Never for the built-in presets: a test parses each.
    #[must_use]
    pub fn table(&self) -> Table {
        self.text.parse().expect("a built-in preset is valid TOML")
    }
}
