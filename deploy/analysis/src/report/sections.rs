//! The text of a report for the web page and for Markdown: tables and figures of the paper, then
//! details.

use dmprl_run::safe_name;
use serde::Serialize;

use super::contents::Report;
use super::efficiency::EfficiencyRow;
use super::filmstrips::Filmstrip;
use super::layout::{Grid, GridCell, GridRow, Picture};
use super::measures::{Measure, MeasureKind};
use super::provenance::Provenance;
use super::results::Results;
use super::statements::{
    ClaimResult, EPISODES_MIN, Limits, PaperClaims, SEEDS_MIN, SUBJECTS, counts,
};
use super::tables::Table;
use super::{families, findings, overview, paper};

/// Explains the tables.
const TABLES_NOTE: &str = "A cell has the mean ± the standard deviation over seeds, rounded to one \
    or two digits of the latter; the best mean of a task is bold. With four or more seeds, the \
    second line is the interquartile mean (IQM) with its 95 % interval by stratified bootstrap. \
    The bounds of a method are this interval, or with fewer seeds the range over them. figures.csv \
    has all of them unrounded. Only finished runs are included. † marks figures over runs with \
    different program or package versions, or over runs that did not record them; see Provenance.";

/// Explains the learning curves.
const CURVES: &str = "Evaluations without exploration noise: mean over the seeds (n), and a band \
    from the lowest seed to the highest.";
/// Explains the marks of the paper's results.
const CURVES_OF_PAPER: &str = "Triangles at the right edge mark the final results in the paper \
    (Tables 3 and 4), which may be after a different number of steps.";
/// Explains the steps to the thresholds.
const EFFICIENCY: &str = "Environment steps until an evaluation's mean first reaches the \
    threshold: median over the seeds, with its 95 % interval by bootstrap (the range for fewer \
    than four seeds), and the number of finished seeds that reached it. A seed that never \
    reached it counts as infinite. The resolution is the interval between evaluations.";
/// Explains return against smoothness.
const PARETO: &str = "A point for each method, with bars for its bounds. The line connects the \
    methods that no other beats in both directions.";
/// Explains the filmstrips.
const FRAMES: &str = "One episode after training, without exploration noise, of the best method \
    with a dmp policy and of DDPG, reset with the same seed.";
/// Explains the joint trajectories.
const JOINTS: &str = "One episode of each method's policy after training, without exploration \
    noise, reset with the same seed. All panels of a picture have the same axes.";
/// Explains that pictures of a large grid leave out methods.
const BEST_SETTINGS: &str = "Of each method, only the values with the best last evaluations are \
    shown.";
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
    /// Conclusion from the table or figure, as a sentence.
    pub finding: Option<String>,
    /// Paragraphs.
    pub about: Vec<String>,
    /// Table.
    pub grid: Option<Grid>,
    /// Plots.
    pub pictures: Vec<Picture>,
    /// True if two plots fit beside each other.
    pub has_pairs: bool,
    /// Frames of rollouts, by task.
    pub filmstrips: Vec<Vec<Filmstrip>>,
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

/// The text of a report.
pub struct Text {
    /// Paragraphs at the top: the runs, and how to read the tables.
    pub summary: Vec<String>,
    /// The tables and figures of the paper, without empty ones.
    pub main: Vec<Section>,
    /// Everything else, which the pages show on request.
    pub details: Vec<Section>,
}

impl Text {
    /// Writes the text of a report.
    #[must_use]
    pub fn of(report: &Report) -> Self {
        let mut text =
            Self { summary: summary(report), main: main(report), details: details(report) };
        for section in text.main.iter_mut().chain(&mut text.details) {
            section.grid = section.grid.take().map(Grid::with_values_in_rows);
        }
        if report.results.methods.iter().any(|method| method == paper::INTERPRETED_METHOD) {
            text.summary.push(paper::INTERPRETATION_NOTE.to_owned());
            let sections = text.main.iter_mut().chain(&mut text.details);
            let grids = sections.filter_map(|section| section.grid.as_mut());
            let columns = grids.flat_map(|grid| &mut grid.columns);
            for column in columns.filter(|column| *column == paper::INTERPRETED_METHOD) {
                column.push_str(" ¹");
            }
        }
        text
    }
}

fn summary(report: &Report) -> Vec<String> {
    let mut summary = vec![overview::summary(&report.results)];
    let claims = &report.claims.results;
    let verdicts = SUBJECTS
        .into_iter()
        .filter(|subject| report.results.methods.iter().any(|method| method == subject))
        .map(|subject| {
            let counts = counts(claims, subject).into_iter();
            let counts = counts.map(|(verdict, count)| format!("{count} \"{}\"", verdict.text()));
            let counts: Vec<String> = counts.collect();
            format!("{} with {subject} as its DDPG-DMP", counts.join(", "))
        });
    let verdicts: Vec<String> = verdicts.collect();
    if !(claims.is_empty() || verdicts.is_empty()) {
        let (count, verdicts) = (claims.len(), verdicts.join("; "));
        let all = count + report.claims.left_out;
        summary.push(format!("Verdicts on {count} of the paper's {all} statements: {verdicts}."));
    }
    summary.push(TABLES_NOTE.to_owned());
    summary
}

fn main(report: &Report) -> Vec<Section> {
    let results = &report.results;
    // Other tasks have the same tables and figures, which then are not the paper's.
    let mut cells = report.tables.iter().flat_map(|table| &table.rows).flat_map(|(_, row)| row);
    let is_papers = cells.any(|cell| cell.paper.is_some());
    let title = |title: &str, place: &str| {
        if is_papers { format!("{title} ({place})") } else { title.to_owned() }
    };
    let mut sections: Vec<Section> = Vec::new();
    for table in report.tables.iter().filter(|table| table.measure.kind() == MeasureKind::Result) {
        let mut section = of_table(report, table);
        let place = if table.measure == Measure::Success { "Table 4" } else { "Table 3" };
        section.title = title(&section.title, place);
        sections.push(section);
    }
    if !report.curves.main.is_empty() {
        let mut curves = Section::new(&title("Learning curves", "Figures 3 and 4"), &[CURVES]);
        curves.finding = findings::first_to_threshold(&report.efficiency, &results.methods);
        curves.about.extend(is_papers.then(|| CURVES_OF_PAPER.to_owned()));
        curves.about.extend(results.shows_best_settings().then(|| BEST_SETTINGS.to_owned()));
        curves.pictures = report.curves.main.clone();
        curves.has_pairs = true;
        sections.push(curves);
    }
    if !report.pareto.is_empty() {
        let mut pareto = Section::new("Return and smoothness", &[PARETO]);
        pareto.finding = findings::front(results);
        let keys = families::keys(&results.methods);
        if !keys.is_empty() {
            pareto.about.push(format!(
                "The numbers beside the points are values of {}, where there is room. A thin \
                 line connects the points of a method.",
                keys.join(", ")
            ));
        }
        pareto.pictures = report.pareto.clone();
        sections.push(pareto);
    }
    if !report.filmstrips.is_empty() {
        let mut frames = Section::new(&title("Frames of a rollout", "Figure 5"), &[FRAMES]);
        frames.finding = findings::frames(results, &report.filmstrips);
        let tasks = report.filmstrips.chunk_by(Filmstrip::is_of_same_task);
        frames.filmstrips = tasks.map(<[_]>::to_vec).collect();
        sections.push(frames);
    }
    if !report.trajectories.is_empty() {
        let mut joints =
            Section::new(&title("Joints over a rollout", "Figures 6 and 7"), &[JOINTS]);
        joints.finding = findings::joints(results);
        joints.about.extend(results.shows_best_settings().then(|| BEST_SETTINGS.to_owned()));
        joints.pictures = report.trajectories.clone();
        sections.push(joints);
    }
    sections
}

fn details(report: &Report) -> Vec<Section> {
    let of_kind = |kind: MeasureKind| {
        let tables = report.tables.iter().filter(move |table| table.measure.kind() == kind);
        tables.map(|table| of_table(report, table))
    };
    let mut sections: Vec<Section> = of_kind(MeasureKind::Smoothness).collect();
    if !report.efficiency.is_empty() {
        sections.push(efficiency(report));
    }
    if !report.curves.others.is_empty() {
        let mut curves = Section::new("Return of tasks with a success rate", &[CURVES]);
        curves.pictures = report.curves.others.clone();
        curves.has_pairs = true;
        sections.push(curves);
    }
    sections.extend(of_kind(MeasureKind::Cost));
    if !report.claims.results.is_empty() {
        sections.push(statements(&report.claims));
    }
    sections.push(runs(&report.results));
    sections.push(provenance(&report.results));
    sections
}

fn of_table(report: &Report, table: &Table) -> Section {
    let mut section = Section::new(table.title, &[table.about]);
    section.finding = findings::best(table, &report.results.methods);
    let usual_seeds = table.usual_seeds();
    if let Some(seeds) = &usual_seeds {
        section.about[0].push_str(&format!(" Over {seeds} unless a cell says otherwise."));
    }
    let rows = table.rows.iter().map(|(task, cells)| {
        let cells = cells.iter().zip(table.best(cells)).map(|(cell, is_best)| GridCell {
            lines: cell.lines(table.digits, usual_seeds.as_deref()),
            is_best,
        });
        GridRow { name: task.clone(), cells: cells.collect() }
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
    let rows = report.efficiency.iter().map(|row| GridRow {
        name: format!("{}, {}", row.task, row.threshold),
        cells: row.cells.iter().map(|cell| cell.lines().into()).collect(),
    });
    section.grid = Some(Grid { columns: report.results.methods.clone(), rows: rows.collect() });
    section
}

fn runs(results: &Results) -> Section {
    let mut section = Section::new("What was run", &[]);
    section.about = overview::omissions(results);
    section.grid = Some(overview::runs_table(results));
    section.files = results.sweeps.clone();
    section
}

fn provenance(results: &Results) -> Section {
    let provenance = Provenance::of(results);
    let mut section = Section::new("Provenance", &[PROVENANCE, &provenance.legend()]);
    section.grid = Some(provenance.grid);
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
    if claims.left_out > 0 {
        section.about.push(format!(
            "{} statements are left out, because a method has no run on their task.",
            claims.left_out
        ));
    }
    section.statements = claims.results.clone();
    section
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{FixtureRun, fixture_results};
    use super::super::statements::evaluate_statements;
    use super::*;

    #[test]
    fn statements_about_methods_without_runs_are_counted() {
        let run = FixtureRun {
            task: "reacher-v1",
            method: "NDP",
            seed: 1,
            rows: vec![-20.0, -15.0],
            ended: true,
        };
        let section = statements(&evaluate_statements(&fixture_results(&[run])).unwrap());
        let claims: Vec<&str> = section.statements.iter().map(|it| it.claim.as_str()).collect();
        assert_eq!(claims, ["NDP's learning curve shows no improvement"]);
        let left_out = "33 statements are left out, because a method has no run on their task.";
        assert_eq!(section.about[1], left_out);
    }
}
