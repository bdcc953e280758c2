//! The tasks with a short name, and what differs from the defaults for each.

use toml::Table;

/// A task known by a short name.
#[derive(Debug)]
pub struct TaskDefaults {
    /// The name for `dmprl train NAME`.
    pub name: &'static str,
    /// What it is.
    pub about: &'static str,
    text: &'static str,
}

/// Every task with a short name.
pub const TASKS: [TaskDefaults; 2] = [
    TaskDefaults {
        name: "reacher",
        about: "two-joint planar arm reaches a target (Gymnasium Reacher-v5)",
        text: REACHER,
    },
    TaskDefaults {
        name: "pusher",
        about: "seven-joint arm pushes a cylinder to a goal (Gymnasium Pusher-v5)",
        text: PUSHER,
    },
];

// Observation of Reacher-v5: cos (2), sin (2), target (2), angular velocity (2),
// fingertip - target.
const REACHER: &str = r#"
[task]
id = "Reacher-v5"
start_sources = [
    { cos = 0, sin = 2, velocity = 6 },
    { cos = 1, sin = 3, velocity = 7 },
]
[run]
steps = 60000
"#;

// Observation of Pusher-v5: joint angles (7), joint velocities (7), tips, object, goal (3 each).
const PUSHER: &str = r#"
[task]
id = "Pusher-v5"
start_sources = [
    { index = 0, velocity = 7 },
    { index = 1, velocity = 8 },
    { index = 2, velocity = 9 },
    { index = 3, velocity = 10 },
    { index = 4, velocity = 11 },
    { index = 5, velocity = 12 },
    { index = 6, velocity = 13 },
]
[run]
steps = 200000
"#;

impl TaskDefaults {
    /// The task's values, its name included.
    ///
    /// # Panics
    /// Never for the built-in tasks: a test parses each.
    #[must_use]
    pub fn table(&self) -> Table {
        let mut table: Table = self.text.parse().expect("a built-in task is valid TOML");
        let task = table.get_mut("task").and_then(toml::Value::as_table_mut);
        let task = task.expect("a built-in task has a [task] table");
        task.insert("name".into(), self.name.into());
        table
    }
}

/// The defaults of a task by its short name.
#[must_use]
pub fn task_defaults(name: &str) -> Option<&'static TaskDefaults> {
    TASKS.iter().find(|task| task.name == name)
}
