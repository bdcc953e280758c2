//! Elements of a report's sections: pictures and tables.

use serde::Serialize;

use super::results::Results;

/// A picture.
#[derive(Debug, Clone, Serialize)]
pub struct Picture {
    /// Path relative to the folder of the report, without the extension.
    pub path: String,
    /// Alternative text.
    pub alt: String,
    /// The picture as SVG.
    pub svg: String,
}

/// A table by task and method, whose cells have several lines.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Grid {
    /// Headings of the columns.
    pub columns: Vec<String>,
    /// Rows: a task and its cells.
    pub rows: Vec<(String, Vec<Vec<String>>)>,
}

impl Grid {
    /// Calls `cell` for each task and method.
    pub fn of(results: &Results, cell: impl Fn(&str, &str) -> Vec<String>) -> Self {
        let rows = results.tasks.iter().map(|task| {
            let cells = results.methods.iter().map(|method| cell(task, method));
            (task.clone(), cells.collect())
        });
        Self { columns: results.methods.clone(), rows: rows.collect() }
    }
}
