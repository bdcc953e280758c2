//! Writes a report as Markdown.

use super::contents::Report;
use super::layout::Grid;
use super::sections::{Section, TABLES_NOTE, sections};
use super::statements::ClaimResult;

/// Returns the content of `report.md`.
#[must_use]
pub fn markdown(report: &Report) -> String {
    let mut text = format!("# {}\n\nMade by `{}` at {}", report.title, report.command, report.made);
    if let Some(commit) = &report.commit {
        text.push_str(&format!(", commit {commit}"));
    }
    text.push_str(".\n\nIn the tables: ");
    text.push_str(TABLES_NOTE);
    text.push('\n');
    for section in sections(report) {
        text.push_str(&section_text(&section));
    }
    text
}

fn section_text(section: &Section) -> String {
    let mut text = format!("\n## {}\n", section.title);
    for paragraph in &section.about {
        text.push_str(&format!("\n{paragraph}\n"));
    }
    if let Some(grid) = &section.grid {
        text.push_str(&grid_text(grid));
    }
    if !section.statements.is_empty() {
        text.push_str(&statements_text(&section.statements));
    }
    for picture in &section.pictures {
        text.push_str(&format!("\n![{}]({}.svg)\n", picture.alt, picture.path));
    }
    for filmstrip in &section.filmstrips {
        text.push_str(&format!("\n![{}]({}.png)\n", filmstrip.alt, filmstrip.path));
    }
    for (name, file) in &section.files {
        text.push_str(&format!(
            "\n<details><summary>The sweep <code>{name}</code></summary>\n\n```toml\n{}\n```\n\n\
             </details>\n",
            file.trim_end()
        ));
    }
    text
}

fn grid_text(grid: &Grid) -> String {
    let cells = |cells: Vec<String>| format!("{}|\n", cells.concat());
    let cell = |text: &str| format!("| {} ", text.replace('|', "\\|"));
    let mut text = String::from("\n");
    let head = std::iter::once("Task").chain(grid.columns.iter().map(String::as_str));
    text.push_str(&cells(head.map(cell).collect()));
    text.push_str(&cells(vec!["|---".to_owned(); grid.columns.len() + 1]));
    for (task, row) in &grid.rows {
        let row = row.iter().map(|lines| cell(&lines.join("<br>")));
        text.push_str(&cells(std::iter::once(cell(task)).chain(row).collect()));
    }
    text
}

fn statements_text(claims: &[ClaimResult]) -> String {
    let mut text = String::from("\n| Statement | Verdict |\n|---|---|\n");
    for ClaimResult { task, place, claim, contradiction, findings, .. } in claims {
        let mut lines: Vec<String> = findings
            .iter()
            .map(|finding| format!("**{}**: {}", finding.verdict_text, finding.evidence))
            .collect();
        lines
            .extend(contradiction.iter().map(|how| format!("The paper contradicts itself: {how}")));
        let line =
            format!("| {task}: {claim} ({place}) | {} |\n", lines.join("<br>").replace('|', "\\|"));
        text.push_str(&line);
    }
    text
}
