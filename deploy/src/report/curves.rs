//! Learning curves: evaluation return, or success, over environment steps, one line a method.

use anyhow::anyhow;
use plotters::prelude::*;

use super::collect::Results;
use super::measures::Measure;
use super::paper::reported;
use super::provenance::Makers;
use super::run::Run;
use super::sections::Picture;
use crate::plots::{Axes, Chart, colour};
use crate::run_directory::safe_name;

/// Of the plot with its axes.
const SIZE: (u32, u32) = (760, 520);
/// For the methods' names, which would hide lines if they stood among them: before and behind
/// them, a letter, and at most.
const BESIDE: (u32, u32, u32) = (76, 7, 480);
/// Between two of the names.
const LINE_HEIGHT: i32 = 24;

/// One method's line: (environment steps, mean, lowest, highest) over its seeds.
type Line = Vec<(f64, f64, f64, f64)>;

/// Every task's returns, and its success where it has some.
///
/// # Errors
/// The picture cannot be drawn.
pub fn curves(results: &Results) -> anyhow::Result<Vec<Picture>> {
    let mut curves = Vec::new();
    for task in &results.tasks {
        for (what, measure) in
            [("evaluation return", Measure::Return), ("success rate", Measure::Success)]
        {
            let methods = results.methods.iter().enumerate();
            let lines: Vec<Drawn> = methods
                .map(|(index, method)| Drawn::of(results, (task, method), measure, index))
                .filter(|drawn| !drawn.line.is_empty())
                .collect();
            if lines.is_empty() {
                continue;
            }
            let svg = draw(task, what, &lines)
                .map_err(|error| anyhow!("cannot draw the curves of {task}: {error}"))?;
            let path = format!("curves/{}-{}", safe_name(task), what.replace(' ', "-"));
            let alt = format!("{task}: {what} over environment steps");
            curves.push(Picture { path, alt, svg });
        }
    }
    Ok(curves)
}

/// The n-th evaluation of each seed belongs together: all are made after the same steps but for
/// the rest of a segment. A line ends where the first seed's does, so no mean changes its members.
fn line(runs: &[&Run], measure: Measure) -> Line {
    let rows = runs.iter().map(|run| run.rows.len()).min().unwrap_or(0);
    let at = |index: usize| {
        let values: Option<Vec<f64>> =
            runs.iter().map(|run| measure.of_row(&run.rows[index])).collect();
        let values = values?;
        let count = runs.len() as f64;
        let steps = runs.iter().map(|run| run.rows[index].env_steps as f64).sum::<f64>() / count;
        let mean = values.iter().sum::<f64>() / count;
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        Some((steps, mean, low, high))
    };
    (0..rows).map_while(at).collect()
}

/// A method's line and what the paper has at its end.
struct Drawn {
    label: String,
    colour: RGBColor,
    line: Line,
    paper: Option<f64>,
}

impl Drawn {
    /// Of the runs at their end, so that a seed that has just begun cuts nothing short; of those
    /// under way while there are no others.
    fn of(results: &Results, (task, method): (&str, &str), measure: Measure, index: usize) -> Self {
        let mut runs: Vec<&Run> = results.of(task, method).filter(|run| run.ended).collect();
        if runs.is_empty() {
            runs = results.of(task, method).filter(|run| !run.rows.is_empty()).collect();
        }
        let paper = measure.in_paper().and_then(|figure| reported(figure, task, method));
        let makers = Makers::of(runs.iter().copied());
        Self {
            label: format!("{method} · n = {}{}", runs.len(), makers.mark()),
            colour: colour(index, method),
            line: line(&runs, measure),
            paper: paper.map(|(mean, _)| mean),
        }
    }
}

fn draw(task: &str, what: &str, lines: &[Drawn]) -> Result<String, Box<dyn std::error::Error>> {
    let points = || lines.iter().flat_map(|drawn| &drawn.line);
    let papers = || lines.iter().filter_map(|drawn| drawn.paper);
    let steps_max = points().map(|point| point.0).fold(1.0, f64::max);
    let low = points().map(|point| point.2).chain(papers()).fold(f64::INFINITY, f64::min);
    let high = points().map(|point| point.3).chain(papers()).fold(f64::NEG_INFINITY, f64::max);
    let mut svg = String::new();
    {
        let letters = lines.iter().map(|drawn| drawn.label.chars().count()).max().unwrap_or(0);
        let beside = (BESIDE.0 + BESIDE.1 * letters as u32).min(BESIDE.2);
        let size = (SIZE.0 + beside, SIZE.1);
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let axes = Axes { title: task, what, steps_max, values: low..high, beside };
        let mut chart = axes.draw(&area)?;
        // Lines last: a band over another method's line would change its colour.
        for drawn in lines {
            draw_band(&mut chart, drawn)?;
        }
        for drawn in lines {
            draw_line(&mut chart, drawn)?;
        }
        let plotted = chart.plotting_area().get_pixel_range();
        let (right, top) = (plotted.0.end, plotted.1.start);
        for drawn in lines {
            if let Some(paper) = drawn.paper {
                let (_, y) = chart.backend_coord(&(steps_max, paper));
                area.draw(&triangle((right + 4, y), drawn.colour))?;
            }
        }
        let words = |text: &str, at: (i32, i32)| {
            let style = ("sans-serif", 14).into_font().color(&BLACK.mix(0.85));
            area.draw_text(text, &style, at)
        };
        let mut y = top + 4;
        for Drawn { label, colour, .. } in lines {
            let stroke = vec![(right + 28, y + 7), (right + 50, y + 7)];
            area.draw(&PathElement::new(stroke, colour.stroke_width(3)))?;
            words(label, (right + 56, y))?;
            y += LINE_HEIGHT;
        }
        if papers().next().is_some() {
            area.draw(&triangle((right + 34, y + 7), RGBColor(90, 90, 90)))?;
            words("the paper's end", (right + 56, y))?;
        }
        area.present()?;
    }
    Ok(svg)
}

/// Points at the plot from its right edge.
fn triangle((x, y): (i32, i32), colour: RGBColor) -> Polygon<(i32, i32)> {
    Polygon::new(vec![(x, y), (x + 10, y - 5), (x + 10, y + 5)], colour.filled())
}

/// From the lowest seed to the highest.
fn draw_band(
    chart: &mut Chart<'_, '_>,
    Drawn { colour, line, .. }: &Drawn,
) -> Result<(), Box<dyn std::error::Error>> {
    let above = line.iter().map(|&(steps, _, _, high)| (steps, high));
    let below = line.iter().rev().map(|&(steps, _, low, _)| (steps, low));
    let band: Vec<_> = above.chain(below).collect();
    chart.draw_series(std::iter::once(Polygon::new(band, colour.mix(0.12))))?;
    Ok(())
}

fn draw_line(
    chart: &mut Chart<'_, '_>,
    Drawn { colour, line, .. }: &Drawn,
) -> Result<(), Box<dyn std::error::Error>> {
    let mean = line.iter().map(|&(steps, mean, _, _)| (steps, mean));
    chart.draw_series(LineSeries::new(mean, colour.stroke_width(2)))?;
    if let [only] = line.as_slice() {
        // A line of one point is none.
        chart.draw_series(std::iter::once(Circle::new((only.0, only.1), 3, colour.filled())))?;
    }
    Ok(())
}
