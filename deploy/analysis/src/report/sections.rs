//! The sections of a report, in order, for the web page and for Markdown.

use dmprl_run::safe_name;
use serde::Serialize;

use super::contents::Report;
use super::efficiency::{EfficiencyCell, EfficiencyRow};
use super::filmstrips::Filmstrip;
use super::layout::{Grid, Picture};
use super::measures::MeasureKind;
use super::overview::{runs_table, sentences};
use super::paper;
use super::provenance::Provenance;
use super::results::Results;
use super::statements::{
    ClaimResult, EPISODES_MIN, Limits, PaperClaims, SEEDS_MIN, SUBJECTS, counts,
};
use super::tables::Table;

/// Explains the cells of the tables.
pub(super) const TABLES_NOTE: &str = "mean ± standard deviation over seeds. With four or more \
    seeds, IQM is the interquartile mean with its 95 % interval by stratified bootstrap; with \
    fewer, the range over the seeds is given instead. Only finished runs are included. † marks \
    figures over runs with different program or package versions, or over runs that did not \
    record them; see Provenance.";

/// Explains the learning curves.
const CURVES: &str = "Evaluations without exploration noise: mean over the seeds (n), and a band \
    from the lowest seed to the highest. Triangles at the right edge mark the final results in \
    the paper (Tables 3 and 4), which may be after a different number of steps.";
/// Explains the steps to the thresholds.
const EFFICIENCY: &str = "Environment steps until an evaluation's mean first reaches the \
    threshold: median over the seeds, with its 95 % interval by bootstrap (the range for fewer \
    than four seeds), and the number of finished seeds that reached it. A seed that never \
    reached it counts as infinite. The resolution is the interval between evaluations.";
/// Explains return against smoothness.
const PARETO: &str = "A point for each method, with bars for the bounds over the seeds (the \
    interval with four or more seeds, else the range). The line connects the methods that no other \
    beats in both directions.";
/// Explains the filmstrips.
const FRAMES: &str = "One episode after training, without exploration noise, of the best method \
    with a dmp policy and of DDPG, reset with the same seed, as in the paper's Figure 5.";
/// Explains the joint trajectories.
const JOINTS: &str = "One episode of each method's policy after training, without exploration \
    noise, reset with the same seed. All panels have the same axes, as in the paper's Figures 6 \
    and 7.";
/// Explains the provenance.
const PROVENANCE: &str = "Programs and packages that made the runs of each cell, by number, and \
    the seeds with a measured motion and with a recorded rollout.";

/// A section with its heading.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Section {
    /// Anchor of links.
    pub id: String,
    /// Heading.
    pub title: String,
    /// Paragraphs.
    pub about: Vec<String>,
    /// Table.
    pub grid: Option<Grid>,
    /// Plots.
    pub pictures: Vec<Picture>,
    /// Frames of rollouts.
    pub filmstrips: Vec<Filmstrip>,
    /// Statements of the paper.
    pub statements: Vec<ClaimResult>,
    /// Name and text of files to quote.
    pub files: Vec<(String, String)>,
}

impl Section {
    fn new(title: &str, about: &[&str]) -> Self {
        Self {
            id: safe_name(&title.to_lowercase().replace(' ', "-")),
            title: title.to_owned(),
            about: about.iter().map(|&text| text.to_owned()).collect(),
            ..Self::default()
        }
    }
}

/// Returns the sections of a report, without empty ones.
#[must_use]
pub fn sections(report: &Report) -> Vec<Section> {
    let mut sections = vec![overview(report)];
    let of_kind = |kind: MeasureKind| {
        let tables = report.tables.iter().filter(move |table| table.kind == kind);
        tables.map(|table| of_table(report, table))
    };
    sections.extend(of_kind(MeasureKind::Result));
    if !report.curves.is_empty() {
        let mut curves = Section::new("Learning curves", &[CURVES]);
        curves.pictures = report.curves.clone();
        sections.push(curves);
    }
    if !report.efficiency.is_empty() {
        sections.push(efficiency(report));
    }
    sections.extend(of_kind(MeasureKind::Smoothness));
    if !report.pareto.is_empty() {
        let mut pareto = Section::new("Return and smoothness", &[PARETO]);
        pareto.pictures = report.pareto.clone();
        sections.push(pareto);
    }
    if !report.filmstrips.is_empty() {
        let mut frames = Section::new("Frames of a rollout", &[FRAMES]);
        frames.filmstrips = report.filmstrips.clone();
        sections.push(frames);
    }
    if !report.trajectories.is_empty() {
        let mut joints = Section::new("Joints over a rollout", &[JOINTS]);
        joints.pictures = report.trajectories.clone();
        sections.push(joints);
    }
    sections.extend(of_kind(MeasureKind::Cost));
    if !report.claims.results.is_empty() {
        sections.push(statements(&report.claims));
    }
    if report.results.methods.iter().any(|method| method == paper::INTERPRETED_METHOD) {
        sections.iter_mut().for_each(add_interpretation_note);
    }
    sections.push(provenance(&report.results));
    sections
}

/// Marks the column of the paper's method, and adds a footnote about its interpretation.
fn add_interpretation_note(section: &mut Section) {
    let has_figures =
        section.grid.is_some() || !section.pictures.is_empty() || !section.statements.is_empty();
    if !has_figures {
        return;
    }
    let columns = section.grid.iter_mut().flat_map(|grid| &mut grid.columns);
    for column in columns.filter(|column| *column == paper::INTERPRETED_METHOD) {
        column.push_str(" ¹");
    }
    section.about.push(paper::INTERPRETATION_NOTE.to_owned());
}

fn provenance(results: &Results) -> Section {
    let provenance = Provenance::of(results);
    let mut section = Section::new("Provenance", &[PROVENANCE, &provenance.legend()]);
    section.grid = Some(provenance.grid);
    section
}

fn overview(report: &Report) -> Section {
    let mut section = Section::new("What was run", &[]);
    section.about.push(sentences(&report.results).join(" "));
    for subject in SUBJECTS {
        let named = report.results.methods.iter().any(|method| method == subject);
        if named && !report.claims.results.is_empty() {
            let counts = counts(&report.claims.results, subject).into_iter();
            let counts: Vec<_> =
                counts.map(|(verdict, count)| format!("{count} {}", verdict.text())).collect();
            section.about.push(format!(
                "The paper's {} statements, with {subject} as its DDPG-DMP: {}.",
                report.claims.results.len(),
                counts.join(", ")
            ));
        }
    }
    section.grid = Some(runs_table(&report.results));
    section.files = report.results.sweeps.clone();
    section
}

fn of_table(report: &Report, table: &Table) -> Section {
    let mut section = Section::new(table.title, &[table.about]);
    let rows = table.rows.iter().map(|(task, cells)| {
        (task.clone(), cells.iter().map(|cell| cell.lines(table.digits)).collect())
    });
    section.grid = Some(Grid { columns: report.results.methods.clone(), rows: rows.collect() });
    section
}

fn efficiency(report: &Report) -> Section {
    let mut section = Section::new("Sample efficiency", &[EFFICIENCY]);
    let sources =
        report.efficiency.iter().map(|EfficiencyRow { task, threshold, source, .. }| {
            format!("{task}: {threshold} ({source})")
        });
    section.about.push(format!("Thresholds: {}.", sources.collect::<Vec<_>>().join("; ")));
    let rows = report.efficiency.iter().map(|row| {
        let cells = row.cells.iter().map(EfficiencyCell::lines);
        (format!("{}, {}", row.task, row.threshold), cells.collect())
    });
    section.grid = Some(Grid { columns: report.results.methods.clone(), rows: rows.collect() });
    section
}

fn statements(claims: &PaperClaims) -> Section {
    let Limits { failure, almost_always, loss, .. } = claims.limits;
    let about = format!(
        "The paper's statements are evaluated as rules on the figures of the runs. \"Held\" and \
         \"did not hold\" require at least {SEEDS_MIN} seeds of each method, {EPISODES_MIN} \
         episodes in each last evaluation, and 95 % intervals that do not overlap (of the \
         interquartile mean, or of the median for steps). With fewer seeds or episodes, the \
         verdict is \"too few seeds\" or \"too few episodes\". Statements about the course of \
         training also use the earlier evaluations, with any number of episodes. If intervals \
         overlap, the verdict is \"no clear difference\". Statements that methods are alike, or \
         that a method does not improve, hold if there is no clear difference. \"Cannot hold\" \
         means that the paper's own figures contradict the statement. Failure is a success rate \
         of at most {failure}; almost always is a rate of at least {almost_always}; a loss is more \
         than {loss} of the gain, measured with moving means of five evaluations. The paper \
         trained for about 200,000 steps; nothing is extrapolated."
    );
    let mut section = Section::new("Statements of the paper", &[&about]);
    section.statements = claims.results.clone();
    section
}
