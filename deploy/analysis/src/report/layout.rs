//! Elements of a report's sections: pictures and tables.

use serde::Serialize;

use super::results::Results;

/// Returns the distinct values in order.
pub(super) fn distinct<T: PartialEq>(values: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut known = Vec::new();
    for value in values {
        if !known.contains(&value) {
            known.push(value);
        }
    }
    known
}

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

/// A table by task and method.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Grid {
    /// Headings of the columns.
    pub columns: Vec<String>,
    /// Rows.
    pub rows: Vec<GridRow>,
}

/// A row of a table.
#[derive(Debug, Clone, Default, Serialize)]
pub struct GridRow {
    /// Heading, which begins with the task.
    pub name: String,
    /// Cells in the order of the columns.
    pub cells: Vec<GridCell>,
}

/// A cell of a table.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct GridCell {
    /// Lines of text.
    pub lines: Vec<String>,
    /// True if it is the best of its row.
    pub is_best: bool,
}

impl From<Vec<String>> for GridCell {
    fn from(lines: Vec<String>) -> Self {
        Self { lines, is_best: false }
    }
}

impl Grid {
    /// Calls `cell` for each task and method.
    pub fn of(results: &Results, cell: impl Fn(&str, &str) -> Vec<String>) -> Self {
        let rows = results.tasks.iter().map(|task| {
            let cells = results.methods.iter().map(|method| cell(task, method).into());
            GridRow { name: task.clone(), cells: cells.collect() }
        });
        Self { columns: results.methods.clone(), rows: rows.collect() }
    }
}
