//! Writes a report as Markdown.

use super::contents::Report;
use super::layout::{Grid, GridCell, GridRow, Picture};
use super::sections::{Section, Text};
use super::statements::ClaimResult;

/// Returns the content of `report.md`.
#[must_use]
pub fn markdown(report: &Report) -> String {
    let mut text = format!("# {}\n\nMade by `{}` at {}", report.title, report.command, report.made);
    if let Some(commit) = &report.commit {
        text.push_str(&format!(", commit {commit}"));
    }
    text.push_str(".\n");
    let Text { summary, main, details } = Text::of(report);
    for paragraph in &summary {
        text.push_str(&format!("\n{paragraph}\n"));
    }
    for section in &main {
        text.push_str(&format!("\n## {}\n{}", section.title, section_text(section)));
    }
    text.push_str("\n## Details\n");
    for section in &details {
        text.push_str(&folded(&section.title, &section_text(section)));
    }
    text
}

/// Returns text that a click on its summary shows.
fn folded(summary: &str, text: &str) -> String {
    format!("\n<details><summary>{summary}</summary>\n{text}\n</details>\n")
}

fn section_text(section: &Section) -> String {
    let mut text = String::new();
    if let Some(finding) = &section.finding {
        text.push_str(&format!("\n**{finding}**\n"));
    }
    for paragraph in &section.about {
        text.push_str(&format!("\n{paragraph}\n"));
    }
    if let Some(grid) = &section.grid {
        text.push_str(&grid_text(grid));
    }
    if !section.statements.is_empty() {
        text.push_str(&statements_text(&section.statements));
    }
    if section.has_pairs {
        text.push_str(&pairs_text(&section.pictures));
    } else {
        for Picture { alt, path, .. } in &section.pictures {
            text.push_str(&format!("\n![{alt}]({path}.svg)\n"));
        }
    }
    for filmstrips in &section.filmstrips {
        text.push('\n');
        for filmstrip in filmstrips {
            text.push_str(&format!("![{}]({}.png)\n", filmstrip.alt, filmstrip.path));
        }
    }
    for (name, file) in &section.files {
        let summary = format!("The sweep <code>{name}</code>");
        text.push_str(&folded(&summary, &format!("\n```toml\n{}\n```\n", file.trim_end())));
    }
    text
}

/// Shows two pictures in each row. Markdown has no width of pictures, so this is HTML.
fn pairs_text(pictures: &[Picture]) -> String {
    let picture = |Picture { path, alt, .. }: &Picture| {
        format!("<img src=\"{path}.svg\" alt=\"{alt}\" width=\"49%\">")
    };
    let pairs = pictures.chunks(2).map(|pair| {
        let pair: Vec<_> = pair.iter().map(picture).collect();
        format!("\n<p>{}</p>\n", pair.join("\n"))
    });
    pairs.collect()
}

fn grid_text(grid: &Grid) -> String {
    let cells = |cells: Vec<String>| format!("{}|\n", cells.concat());
    let cell = |text: &str| format!("| {} ", text.replace('|', "\\|"));
    let mut text = String::from("\n");
    let head = std::iter::once("Task").chain(grid.columns.iter().map(String::as_str));
    text.push_str(&cells(head.map(cell).collect()));
    text.push_str(&cells(vec!["|---".to_owned(); grid.columns.len() + 1]));
    for GridRow { name, cells: row } in &grid.rows {
        let row = row.iter().map(|GridCell { lines, is_best }| {
            let mut lines = lines.clone();
            if let (true, Some(first)) = (is_best, lines.first_mut()) {
                *first = format!("**{first}**");
            }
            cell(&lines.join("<br>"))
        });
        text.push_str(&cells(std::iter::once(cell(name)).chain(row).collect()));
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
