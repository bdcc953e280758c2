//! Elements of a report's sections: pictures and tables.

use serde::Serialize;

use super::families::{self, distinct};
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
    /// True if it is the best of its task.
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

    /// Moves the values of a sweep's grid from the columns into the rows. The columns are then the
    /// names of the methods, and each task has a row for each combination of values.
    #[must_use]
    pub(super) fn with_values_in_rows(self) -> Self {
        let columns: Vec<_> = self.columns.iter().map(|label| families::split(label)).collect();
        let names = families::names(&self.columns);
        if names.len() == columns.len() {
            return self;
        }
        let combinations = distinct(columns.iter().map(|(_, values)| values));
        let mut rows = Vec::new();
        for GridRow { name: task, cells } in &self.rows {
            rows.extend(combinations.iter().map(|values| {
                let place =
                    |name: &str| columns.iter().position(|it| (it.0, &it.1) == (name, values));
                let cell =
                    |name: &&str| place(name).map(|at| cells[at].clone()).unwrap_or_default();
                let values = values.iter().map(|(key, value)| format!(", {key}={value}"));
                GridRow {
                    name: std::iter::once(task.clone()).chain(values).collect(),
                    cells: names.iter().map(cell).collect(),
                }
            }));
        }
        Self { columns: names.into_iter().map(str::to_owned).collect(), rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(columns: &[&str]) -> Grid {
        let cells = columns.iter().map(|label| vec![(*label).to_owned()].into()).collect();
        Grid {
            columns: columns.iter().map(|&label| label.to_owned()).collect(),
            rows: vec![GridRow { name: "reacher-v1".to_owned(), cells }],
        }
    }

    #[test]
    fn values_of_a_grid_are_rows() {
        let labels = ["A, x=1, y=3", "A, x=2, y=3", "B, late, x=2, y=3", "C"];
        let Grid { columns, rows } = grid(&labels).with_values_in_rows();
        assert_eq!(columns, ["A", "B, late", "C"]);
        let rows: Vec<(&str, Vec<String>)> = rows
            .iter()
            .map(|row| (&*row.name, row.cells.iter().map(|cell| cell.lines.concat()).collect()))
            .collect();
        let cells = |texts: [&str; 3]| texts.map(str::to_owned).to_vec();
        assert_eq!(
            rows,
            [
                ("reacher-v1, x=1, y=3", cells([labels[0], "", ""])),
                ("reacher-v1, x=2, y=3", cells([labels[1], labels[2], ""])),
                ("reacher-v1", cells(["", "", "C"])),
            ]
        );
    }

    #[test]
    fn a_table_of_different_methods_is_unchanged() {
        let columns = ["DMP", "DMP, last action", "MLP, x=1"];
        assert_eq!(grid(&columns).with_values_in_rows().columns, columns);
    }
}
