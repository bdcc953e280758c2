//! Tasks with a short name, and the configuration values that each changes.

use serde::Serialize;
use toml::Table;

use crate::spec::EnvSpec;

/// A task with a short name.
///
/// `dmprl tasks` prints these fields without starting Python. A test compares them with the
/// environment.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct TaskDefaults {
    /// The name for `dmprl train NAME`.
    pub name: &'static str,
    /// Gymnasium id.
    pub id: &'static str,
    /// One-line description.
    pub about: &'static str,
    /// Meaning and bounds of an action.
    pub control: &'static str,
    /// Origin of the task.
    pub source: &'static str,
    /// Length O of an observation.
    pub observation_len: usize,
    /// Lower bound of each action dimension; its length is A.
    pub action_low: &'static [f64],
    /// Upper bound of each action dimension.
    pub action_high: &'static [f64],
    /// Steps per episode.
    pub episode_steps: u32,
    /// Duration of a step \[s\].
    pub control_dt_s: f64,
    /// Values merged over the defaults, as parts of one TOML text.
    #[serde(skip)]
    values: &'static [&'static str],
    /// Names of presets, and values that are merged over them for this task.
    #[serde(skip)]
    over_presets: &'static [(&'static str, &'static str)],
}

const REACHER: TaskDefaults = TaskDefaults {
    name: "reacher",
    id: "Reacher-v5",
    about: "two-joint planar arm moves its fingertip to a target",
    control: "torque, ±1 (gear 200)",
    source: "Gymnasium, batched, bit-identical",
    observation_len: 10,
    action_low: &[-1.0; 2],
    action_high: &[1.0; 2],
    episode_steps: 50,
    control_dt_s: 0.02,
    values: REACHER_VALUES,
    over_presets: &[("fast", REACHER_FAST)],
};

const PUSHER: TaskDefaults = TaskDefaults {
    name: "pusher",
    id: "Pusher-v5",
    about: "seven-joint arm pushes a cylinder to a goal",
    control: "torque, ±2",
    source: "Gymnasium, batched, bit-identical",
    observation_len: 23,
    action_low: &[-2.0; 7],
    action_high: &[2.0; 7],
    episode_steps: 100,
    control_dt_s: 0.05,
    values: ARM_VALUES,
    over_presets: &[],
};

const THROWER: TaskDefaults = TaskDefaults {
    name: "thrower",
    id: "dmprl/Thrower-v0",
    about: "seven-joint arm throws a ball into a box",
    control: "torque, ±10, last three joints ±15",
    source: "OpenAI Gym 0.9.4, rebuilt",
    action_low: &[-10.0, -10.0, -10.0, -10.0, -15.0, -15.0, -15.0],
    action_high: &[10.0, 10.0, 10.0, 10.0, 15.0, 15.0, 15.0],
    values: THROWER_VALUES,
    ..PUSHER
};

const PANDA_REACH: TaskDefaults = TaskDefaults {
    name: "panda-reach",
    id: "dmprl/PandaReach-v0",
    about: "Franka Panda moves its gripper to a goal",
    control: "gripper displacement, ±1 = 5 cm per step",
    source: "panda-gym's task, in MuJoCo",
    observation_len: 20,
    action_low: &[-1.0; 3],
    action_high: &[1.0; 3],
    episode_steps: 50,
    control_dt_s: 0.04,
    values: PANDA_REACH_VALUES,
    over_presets: &[("paper", PANDA_PAPER)],
};

const PANDA_REACH_JOINTS: TaskDefaults = TaskDefaults {
    name: "panda-reach-joints",
    id: "dmprl/PandaReachJoints-v0",
    control: "joint displacement, ±1 = 0.05 rad per step",
    action_low: &[-1.0; 7],
    action_high: &[1.0; 7],
    values: PANDA_REACH_JOINTS_VALUES,
    over_presets: &[("paper", PANDA_PAPER), ("fast", PANDA_REACH_JOINTS_FAST)],
    ..PANDA_REACH
};

const PANDA_PUSH: TaskDefaults = TaskDefaults {
    name: "panda-push",
    id: "dmprl/PandaPush-v0",
    about: "Franka Panda pushes a cube to a goal, sparse reward",
    observation_len: 27,
    values: PANDA_PUSH_VALUES,
    over_presets: &[("goal", PANDA_GOAL)],
    ..PANDA_REACH
};

const PANDA_PUSH_DENSE: TaskDefaults = TaskDefaults {
    name: "panda-push-dense",
    id: "dmprl/PandaPushDense-v0",
    about: "panda-push with minus the distance as reward",
    ..PANDA_PUSH
};

const PANDA_SLIDE: TaskDefaults = TaskDefaults {
    name: "panda-slide",
    id: "dmprl/PandaSlide-v0",
    about: "Franka Panda makes a puck slide to a goal out of reach, sparse reward",
    observation_len: 28,
    values: PANDA_SLIDE_VALUES,
    over_presets: &[("goal", SLIDE_GOAL)],
    ..PANDA_PUSH
};

const PANDA_SLIDE_DENSE: TaskDefaults = TaskDefaults {
    name: "panda-slide-dense",
    id: "dmprl/PandaSlideDense-v0",
    about: "panda-slide with minus the distance as reward",
    ..PANDA_SLIDE
};

const PANDA_PICK_AND_PLACE: TaskDefaults = TaskDefaults {
    name: "panda-pick-and-place",
    id: "dmprl/PandaPickAndPlace-v0",
    about: "Franka Panda brings a cube to a goal on or above the table, sparse reward",
    control: "gripper displacement, ±1 = 5 cm, and opening, ±1 = 20 cm per step",
    observation_len: 29,
    action_low: &[-1.0; 4],
    action_high: &[1.0; 4],
    values: PANDA_PICK_AND_PLACE_VALUES,
    ..PANDA_PUSH
};

const PANDA_PICK_AND_PLACE_DENSE: TaskDefaults = TaskDefaults {
    name: "panda-pick-and-place-dense",
    id: "dmprl/PandaPickAndPlaceDense-v0",
    about: "panda-pick-and-place with minus the distance as reward",
    ..PANDA_PICK_AND_PLACE
};

const PANDA_STACK: TaskDefaults = TaskDefaults {
    name: "panda-stack",
    id: "dmprl/PandaStack-v0",
    about: "Franka Panda stacks two cubes at a goal, sparse reward",
    observation_len: 50,
    episode_steps: 100,
    values: PANDA_STACK_VALUES,
    ..PANDA_PICK_AND_PLACE
};

const PANDA_STACK_DENSE: TaskDefaults = TaskDefaults {
    name: "panda-stack-dense",
    id: "dmprl/PandaStackDense-v0",
    about: "panda-stack with minus the distance as reward",
    ..PANDA_STACK
};

const BOX_PUSHING: TaskDefaults = TaskDefaults {
    name: "box-pushing",
    id: "dmprl/BoxPushingDense-v0",
    about: "Franka Panda with a rod pushes and turns a box, reward in each step",
    control: "torque, ±1 = 10 N m, gravity compensated",
    source: "fancy-gym's task, rebuilt",
    observation_len: 28,
    action_low: &[-1.0; 7],
    action_high: &[1.0; 7],
    episode_steps: 100,
    control_dt_s: 0.02,
    values: BOX_PUSHING_VALUES,
    over_presets: &[],
};

const BOX_PUSHING_SPARSE: TaskDefaults = TaskDefaults {
    name: "box-pushing-sparse",
    id: "dmprl/BoxPushingTemporalSparse-v0",
    about: "box-pushing, rewarded for the goal at the last step only",
    ..BOX_PUSHING
};

const REACHER_V1: TaskDefaults = TaskDefaults {
    name: "reacher-v1",
    id: "dmprl/Reacher-v1",
    about: "the paper's reacher: some targets out of reach, reward of the previous state",
    source: "OpenAI Gym 0.9.4, on Gymnasium's model",
    observation_len: 11,
    ..REACHER
};

const PUSHER_V0: TaskDefaults = TaskDefaults {
    name: "pusher-v0",
    id: "dmprl/Pusher-v0",
    about: "the paper's pusher: different positions, reward of the previous state",
    source: "OpenAI Gym 0.9.4, on Gymnasium's model",
    values: PUSHER_V0_VALUES,
    ..PUSHER
};

const THROWER_V0: TaskDefaults =
    TaskDefaults { name: "thrower-v0", about: "alias of thrower", ..THROWER };

/// Every task with a short name; the paper's older versions are last.
pub const TASKS: [TaskDefaults; 18] = [
    REACHER,
    PUSHER,
    THROWER,
    PANDA_REACH,
    PANDA_REACH_JOINTS,
    PANDA_PUSH,
    PANDA_PUSH_DENSE,
    PANDA_SLIDE,
    PANDA_SLIDE_DENSE,
    PANDA_PICK_AND_PLACE,
    PANDA_PICK_AND_PLACE_DENSE,
    PANDA_STACK,
    PANDA_STACK_DENSE,
    BOX_PUSHING,
    BOX_PUSHING_SPARSE,
    REACHER_V1,
    PUSHER_V0,
    THROWER_V0,
];

// Observation: cos (2), sin (2), target (2), angular velocity (2), fingertip - target.
const REACHER_VALUES: &[&str] = &[r#"
[task]
start_sources = [
    { cos = 0, sin = 2, velocity = 6 },
    { cos = 1, sin = 3, velocity = 7 },
]
[run]
steps = 60000
"#];

// Observation: joint angles (7), joint velocities (7), three positions (3 each).
const ARM_VALUES: &[&str] = &[JOINTS, "[run]\nsteps = 200000"];

// With half of this noise the arm rarely touched the cylinder. Returns after 60,000 steps (TD3,
// seeds from 5000): -34 to -36 with 0.1, -25 and -31 with 0.2, -37 with 0.3.
const PUSHER_V0_VALUES: &[&str] = &[ARM_VALUES[0], ARM_VALUES[1], "\n[exploration]\nstd = 0.2"];

// Observation: as above. It lacks the ball's landing point, which determines all later rewards.
// With more updates, normalised observations, which magnify near-constant entries, or plain critics
// TD3's return drops again. A throw needs a jerk, so an action-rate penalty of 0.2 reduced it.
const THROWER_VALUES: &[&str] = &[
    ARM_VALUES[0],
    r#"
[run]
steps = 100000
[policy]
normalise_observations = false
[pacing]
updates_per_segment = 1.0
[algorithm]
action_rate_penalty = 0.05
critic_layer_norm = true
"#,
];

// Angles and velocities of seven joints are the first entries of these observations.
const JOINTS: &str = r#"
[task]
start_sources = [
    { index = 0, velocity = 7 },
    { index = 1, velocity = 8 },
    { index = 2, velocity = 9 },
    { index = 3, velocity = 10 },
    { index = 4, velocity = 11 },
    { index = 5, velocity = 12 },
    { index = 6, velocity = 13 },
]
"#;

// Observation: joint angles (7), joint velocities (7), goal - end effector (3), velocity of the end
// effector (3). y0 is the end effector's position relative to the goal.
const PANDA_REACH_VALUES: &[&str] = &[
    r#"
[task]
start_sources = [
    { index = 14, velocity = 17, scale = -1.0 },
    { index = 15, velocity = 18, scale = -1.0 },
    { index = 16, velocity = 19, scale = -1.0 },
]
"#,
    PANDA_RUN,
    r#"
[policy]
position_scale = 20.0
[algorithm]
discount = 0.95
"#,
];

// Smaller networks learn this task in fewer steps and less time.
const PANDA_REACH_JOINTS_VALUES: &[&str] = &[
    JOINTS,
    PANDA_RUN,
    r#"
[policy]
position_scale = 20.0
hidden = [128, 128]
[algorithm]
discount = 0.95
critic_hidden = [128, 128]
"#,
];

// Observation: joint angles (7), joint velocities (7), pose of the box (7), pose of the goal (7).
const BOX_PUSHING_VALUES: &[&str] = &[JOINTS, "[run]\nsteps = 200000"];

// u = 1 moves the gripper or joint by 0.05 m or rad, so with `position_scale = 20` the robot
// follows the DMP's y. These tasks are solved in few steps, which leaves time for more updates per
// step. The discount is from Table 2.
const PANDA_RUN: &str = r#"
[run]
steps = 30000
[exploration]
warm_up_steps = 1000
[pacing]
updates_per_segment = 4.0
"#;

// Observation: achieved goal (3), desired goal (3), position of the end effector (3), its velocity
// (3), position, rotation, velocity and angular velocity of the cube (3 each).
const PANDA_PUSH_VALUES: &[&str] = &[PANDA_HAND, PANDA_OBJECTS, PUSH_RANGE];
const PANDA_SLIDE_VALUES: &[&str] = &[PANDA_HAND, PANDA_OBJECTS, STRIKE_RANGE];
const PANDA_HAND: &str = r#"
[task]
start_sources = [
    { index = 6, velocity = 9 },
    { index = 7, velocity = 10 },
    { index = 8, velocity = 11 },
]
"#;

// As above, but the fingers' width and its velocity follow the end effector.
const PANDA_PICK_AND_PLACE_VALUES: &[&str] = &[
    r#"
[task]
start_sources = [
    { index = 6, velocity = 9 },
    { index = 7, velocity = 10 },
    { index = 8, velocity = 11 },
    { index = 12, velocity = 13 },
]
"#,
    PANDA_OBJECTS,
    PUSH_RANGE,
];

// As above, with goals of two cubes (6 each).
const PANDA_STACK_VALUES: &[&str] = &[
    r#"
[task]
start_sources = [
    { index = 12, velocity = 15 },
    { index = 13, velocity = 16 },
    { index = 14, velocity = 17 },
    { index = 18, velocity = 19 },
]
"#,
    PANDA_OBJECTS,
    STACK_RANGE,
];

const PANDA_OBJECTS: &str = r#"
[run]
steps = 200000
[algorithm]
discount = 0.98
[policy]
position_scale = 20.0
"#;

// An action of 1 moves the end effector by 0.05 m, as in PANDA_REACH_VALUES. At that speed the arm
// strikes a cube more than it pushes it, and sends a puck too far (decisions 0104 and 0126). With
// slower actions stacking takes too long. `--algo ndp`, for which `position_scale` is, uses all of
// the range. These lines continue the last table of PANDA_OBJECTS.
const PUSH_RANGE: &str = "action_range = 0.4\n";
const STRIKE_RANGE: &str = "action_range = 0.5\n";
const STACK_RANGE: &str = "action_range = 0.6\n";

// Table 2 of the paper, column of the Panda tasks.
const PANDA_PAPER: &str = r#"
[algorithm]
discount = 0.95
actor_learning_rate = 0.0003
[exploration]
warm_up_steps = 2000
[replay]
capacity_steps = 100000
"#;

// Small networks learn these tasks sooner, with a larger step
// (docs/decisions/0118-smaller-batches-in-fast.md).
const REACHER_FAST: &str = r#"
[policy]
hidden = [128, 128]
[algorithm]
critic_hidden = [128, 128]
critic_learning_rate = 0.002
actor_learning_rate = 0.002
"#;

// An update of these networks is so short that worker and evaluator need the second core.
const PANDA_REACH_JOINTS_FAST: &str = r#"
[policy]
hidden = [64, 64]
[algorithm]
critic_hidden = [64, 64]
critic_learning_rate = 0.002
actor_learning_rate = 0.002
[exploration]
warm_up_steps = 2000
[learner]
threads = 1
"#;

// docs/decisions/0107-discount-with-goals.md
const PANDA_GOAL: &str = r#"
[algorithm]
discount = 0.95
"#;

// A puck can pass the goal, so only the end of the episode counts, up to 40 steps after the strike
// (docs/decisions/0126-return-after-the-time-limit.md).
const SLIDE_GOAL: &str = "[algorithm]\nafter_time_limit = \"last_reward\"";

impl TaskDefaults {
    /// Returns the spec that the environment reports, without names of observations.
    #[must_use]
    pub fn spec(&self) -> EnvSpec {
        EnvSpec {
            id: self.id.into(),
            observation_len: self.observation_len,
            action_len: self.action_low.len(),
            action_low: self.action_low.to_vec(),
            action_high: self.action_high.to_vec(),
            control_dt_s: self.control_dt_s,
            episode_steps: self.episode_steps,
            observation_names: Vec::new(),
            goal_rule: None,
        }
    }

    /// Returns the task's values, including its name and id.
    ///
    /// # Panics
    /// Never for the built-in tasks: a test parses each.
    #[must_use]
    pub fn table(&self) -> Table {
        let mut table: Table = self.values.concat().parse().expect("a built-in task is valid TOML");
        let task = table.get_mut("task").and_then(toml::Value::as_table_mut);
        let task = task.expect("a built-in task has a [task] table");
        task.insert("name".into(), self.name.into());
        task.insert("id".into(), self.id.into());
        table
    }

    /// Returns the values that are merged over a preset for this task.
    ///
    /// # Panics
    /// Never for the built-in tasks: a test parses each.
    #[must_use]
    pub fn over_preset(&self, preset: &str) -> Table {
        let over = self.over_presets.iter().filter(|(name, _)| *name == preset);
        let text: String = over.map(|(_, values)| *values).collect();
        text.parse().expect("a built-in task is valid TOML")
    }
}

/// Returns the defaults of the task with this short name.
#[must_use]
pub fn task_defaults(name: &str) -> Option<&'static TaskDefaults> {
    TASKS.iter().find(|task| task.name == name)
}

#[cfg(test)]
mod tests;
