//! The report's files: one page that stands alone, the same as Markdown, and the figures as CSV.

use std::path::Path;

use anyhow::Context;
use minijinja::{AutoEscape, Environment, context};

use super::collect::Results;
use super::curves::Curves;
use super::tables::{Cell, Table};

const TEMPLATE: &str = include_str!("page.html");

/// What a report says.
pub struct Report {
    /// Its heading.
    pub title: String,
    /// The command that makes it again.
    pub command: String,
    /// When it was made (RFC 3339).
    pub made: String,
    /// The git commit of the program, where it is known.
    pub commit: Option<String>,
    /// The runs.
    pub results: Results,
    /// The tables.
    pub tables: Vec<Table>,
    /// The pictures.
    pub curves: Vec<Curves>,
}

impl Report {
    /// Writes `index.html`, `report.md`, `figures.csv`, `runs.csv` and `curves/TASK-WHAT.svg`.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn write(&self, folder: &Path) -> anyhow::Result<()> {
        let curves = folder.join("curves");
        std::fs::create_dir_all(&curves)
            .with_context(|| format!("cannot make {}", curves.display()))?;
        for figure in &self.curves {
            write(&curves.join(file_name(figure)), figure.svg.as_bytes())?;
        }
        write(&folder.join("figures.csv"), &self.figures_csv()?)?;
        write(&folder.join("runs.csv"), &self.runs_csv()?)?;
        write(&folder.join("report.md"), self.markdown().as_bytes())?;
        write(&folder.join("index.html"), self.html()?.as_bytes())
    }

    fn html(&self) -> anyhow::Result<String> {
        let lines = |table: &Table, cells: &[Cell]| {
            cells.iter().map(|cell| cell.lines(table.digits)).collect::<Vec<_>>()
        };
        let tables = self.tables.iter().map(|table| {
            let rows = table.rows.iter().map(|(task, cells)| {
                context! { task => task, cells => lines(table, cells) }
            });
            let rows: Vec<_> = rows.collect();
            context! { title => table.title, about => table.about.clone(), rows => rows }
        });
        let mut environment = Environment::new();
        environment.set_auto_escape_callback(|_| AutoEscape::Html);
        environment.add_template("page", TEMPLATE).context("the report's template")?;
        let figures = self.curves.iter().map(|curves| {
            context! { task => curves.task.clone(), what => curves.what, svg => curves.svg.clone() }
        });
        let page = environment.get_template("page")?.render(context! {
            title => self.title.clone(),
            command => self.command.clone(),
            made => self.made.clone(),
            commit => self.commit.clone(),
            methods => self.results.methods.clone(),
            tables => tables.collect::<Vec<_>>(),
            figures => figures.collect::<Vec<_>>(),
        });
        page.context("cannot fill in the report's page")
    }

    fn markdown(&self) -> String {
        let mut text = format!("# {}\n\nMade by `{}` at {}", self.title, self.command, self.made);
        if let Some(commit) = &self.commit {
            text.push_str(&format!(", commit {commit}"));
        }
        text.push_str(".\n");
        for table in &self.tables {
            text.push_str(&format!("\n## {}\n\n{}\n\n", table.title, table.about));
            let methods = self.results.methods.join(" | ");
            text.push_str(&format!("| Task | {methods} |\n"));
            text.push_str(&format!("|---|{}\n", "---|".repeat(self.results.methods.len())));
            for (task, cells) in &table.rows {
                let cells: Vec<_> =
                    cells.iter().map(|cell| cell.lines(table.digits).join("<br>")).collect();
                text.push_str(&format!("| {task} | {} |\n", cells.join(" | ")));
            }
        }
        for figure in &self.curves {
            let (task, what, file) = (&figure.task, figure.what, file_name(figure));
            text.push_str(&format!("\n![{task}: {what}](curves/{file})\n"));
        }
        text
    }

    /// One line a figure, task and method.
    fn figures_csv(&self) -> anyhow::Result<Vec<u8>> {
        let mut csv = csv::Writer::from_writer(Vec::new());
        csv.write_record([
            "figure",
            "task",
            "method",
            "seeds",
            "mean",
            "std",
            "iqm",
            "low",
            "high",
            "paper_mean",
            "paper_std",
        ])?;
        for table in &self.tables {
            for (task, cells) in &table.rows {
                for (method, cell) in self.results.methods.iter().zip(cells) {
                    let number = |value: Option<f64>| {
                        value.map(|value| value.to_string()).unwrap_or_default()
                    };
                    let summary = cell.summary;
                    let count = summary.map_or(0, |summary| summary.count).to_string();
                    let of = [
                        summary.map(|summary| summary.mean),
                        summary.map(|summary| summary.std),
                        summary.map(|summary| summary.iqm),
                        summary.map(|summary| summary.interval[0]),
                        summary.map(|summary| summary.interval[1]),
                        cell.paper.map(|paper| paper.0),
                        cell.paper.map(|paper| paper.1),
                    ];
                    let words = [table.title, task, method, count.as_str()];
                    let words = words.into_iter().map(str::to_owned);
                    csv.write_record(words.chain(of.map(number)))?;
                }
            }
        }
        Ok(csv.into_inner()?)
    }

    /// One line an evaluation of a run.
    fn runs_csv(&self) -> anyhow::Result<Vec<u8>> {
        let mut csv = csv::Writer::from_writer(Vec::new());
        csv.write_record([
            "task",
            "method",
            "seed",
            "env_steps",
            "updates",
            "segments",
            "wall_s",
            "return_mean",
            "success_rate",
            "smoothness",
        ])?;
        for run in &self.results.runs {
            for row in &run.rows {
                csv.write_record([
                    run.task.clone(),
                    run.method.clone(),
                    run.seed.to_string(),
                    row.env_steps.to_string(),
                    row.updates.to_string(),
                    row.segments.to_string(),
                    row.wall_s.to_string(),
                    row.return_mean.to_string(),
                    row.success_rate.map(|rate| rate.to_string()).unwrap_or_default(),
                    row.smoothness.to_string(),
                ])?;
            }
        }
        Ok(csv.into_inner()?)
    }
}

fn file_name(figure: &Curves) -> String {
    let task = crate::run_directory::safe_name(&figure.task);
    format!("{task}-{}.svg", figure.what.replace(' ', "-"))
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
