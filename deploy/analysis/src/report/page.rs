//! Writes the files of a report: a self-contained web page, the same as Markdown, pictures and
//! data.

use std::path::Path;

use anyhow::Context;
use minijinja::value::Serde;
use minijinja::{AutoEscape, Environment, context};

use super::contents::Report;
use super::csv_files::{figures_csv, runs_csv};
use super::markdown::markdown;
use super::sections::Text;
use super::snapshot;
use crate::plots::png;

const TEMPLATE: &str = include_str!("page.html");

impl Report {
    /// Writes `index.html`, `report.md`, `figures.csv`, `runs.csv`, `report-data.json` and each
    /// picture as SVG and PNG.
    ///
    /// # Errors
    /// A picture cannot be rendered, or a file cannot be written.
    pub fn write(&self, folder: &Path) -> anyhow::Result<()> {
        for picture in self.curves.all().chain(&self.pareto).chain(&self.trajectories) {
            let file = |ending: &str| folder.join(format!("{}.{ending}", picture.path));
            let svg = file("svg");
            create_parent(&svg)?;
            write(&svg, picture.svg.as_bytes())?;
            let png = png(&picture.svg).with_context(|| picture.alt.clone())?;
            write(&file("png"), &png)?;
        }
        for filmstrip in &self.filmstrips {
            let file = folder.join(format!("{}.png", filmstrip.path));
            create_parent(&file)?;
            write(&file, &filmstrip.png)?;
        }
        write(&folder.join("figures.csv"), &figures_csv(self)?)?;
        write(&folder.join("runs.csv"), &runs_csv(&self.results.runs)?)?;
        write(&folder.join(snapshot::FILE), &snapshot::encode(&self.results)?)?;
        write(&folder.join("report.md"), markdown(self).as_bytes())?;
        write(&folder.join("index.html"), self.html()?.as_bytes())
    }

    /// Renders `index.html`.
    fn html(&self) -> anyhow::Result<String> {
        let mut environment = Environment::new();
        environment.set_auto_escape_callback(|_| AutoEscape::Html);
        environment.add_template("page", TEMPLATE).context("the report's template is invalid")?;
        let text = Text::of(self);
        let page = environment.get_template("page")?.render(context! {
            title => self.title.clone(),
            command => self.command.clone(),
            made => self.made.clone(),
            commit => self.commit.clone(),
            summary => text.summary,
            main => Serde(text.main),
            details => Serde(text.details),
        });
        page.context("cannot render the report's page")
    }
}

fn create_parent(path: &Path) -> anyhow::Result<()> {
    let Some(parent) = path.parent() else { return Ok(()) };
    std::fs::create_dir_all(parent).with_context(|| format!("cannot create {}", parent.display()))
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
