//! The report's files: one page that stands alone, the same as Markdown, and its data.

use std::path::Path;

use anyhow::Context;
use minijinja::value::Serde;
use minijinja::{AutoEscape, Environment, context};

use super::collect::Results;
use super::data::{figures_csv, runs_csv};
use super::efficiency::EfficiencyRow;
use super::landed::{self, curves_json};
use super::markdown::markdown;
use super::sections::{Picture, sections};
use super::statements::Judged;
use super::strips::Strip;
use super::tables::Table;
use crate::plots::png;

const TEMPLATE: &str = include_str!("page.html");
/// How to read a cell.
pub(super) const READING: &str = "mean ± standard deviation over seeds. From four seeds \
    on, IQM is the interquartile mean with its 95 % interval by stratified bootstrap; below four, \
    the range from the lowest seed to the highest is given instead. Only finished runs count. † \
    marks seeds that different programs or package versions made, or that did not record them; \
    Provenance lists them.";

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
    /// Steps to a threshold.
    pub efficiency: Vec<EfficiencyRow>,
    /// What became of the paper's statements.
    pub judged: Vec<Judged>,
    /// Learning curves.
    pub curves: Vec<Picture>,
    /// Frames of a rollout.
    pub strips: Vec<Strip>,
    /// Joints over a rollout.
    pub trajectories: Vec<Picture>,
}

impl Report {
    /// Writes `index.html`, `report.md`, `figures.csv`, `runs.csv`, `curves.json` and each picture
    /// as SVG and PNG.
    ///
    /// # Errors
    /// What the file system refuses.
    pub fn write(&self, folder: &Path) -> anyhow::Result<()> {
        for picture in self.curves.iter().chain(&self.trajectories) {
            let file = |ending: &str| folder.join(format!("{}.{ending}", picture.path));
            let svg = file("svg");
            make_parent(&svg)?;
            write(&svg, picture.svg.as_bytes())?;
            let png = png(&picture.svg).with_context(|| picture.alt.clone())?;
            write(&file("png"), &png)?;
        }
        for strip in &self.strips {
            let file = folder.join(format!("{}.png", strip.path));
            make_parent(&file)?;
            write(&file, &strip.png)?;
        }
        write(&folder.join("figures.csv"), &figures_csv(self)?)?;
        write(&folder.join("runs.csv"), &runs_csv(&self.results.runs)?)?;
        write(&folder.join(landed::FILE), &curves_json(&self.results)?)?;
        write(&folder.join("report.md"), markdown(self).as_bytes())?;
        write(&folder.join("index.html"), self.html()?.as_bytes())
    }

    fn html(&self) -> anyhow::Result<String> {
        let mut environment = Environment::new();
        environment.set_auto_escape_callback(|_| AutoEscape::Html);
        environment.add_template("page", TEMPLATE).context("the report's template")?;
        let page = environment.get_template("page")?.render(context! {
            title => self.title.clone(),
            command => self.command.clone(),
            made => self.made.clone(),
            commit => self.commit.clone(),
            reading => READING,
            sections => Serde(sections(self)),
        });
        page.context("cannot fill in the report's page")
    }
}

fn make_parent(path: &Path) -> anyhow::Result<()> {
    let Some(parent) = path.parent() else { return Ok(()) };
    std::fs::create_dir_all(parent).with_context(|| format!("cannot make {}", parent.display()))
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
