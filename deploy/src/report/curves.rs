//! Learning curves: evaluation return, or success, over environment steps, one line a method.

use anyhow::anyhow;
use plotters::prelude::*;

use super::collect::{Results, Run};
use crate::control::EvaluationRow;
use crate::plots::{Axes, Chart};

const SIZE: (u32, u32) = (900, 520);
/// Okabe and Ito's palette, told apart with every common colour vision; the yellow, which is hard
/// to see on white, darker.
const COLOURS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
    RGBColor(150, 140, 0),
];
/// Methods that have the same colour in every report.
const KNOWN: [&str; 8] =
    ["DDPG-DMP", "DDPG-DMP (paper)", "TD3-DMP", "SAC-DMP", "DDPG", "TD3", "SAC", "NDP"];

/// A picture of one task.
#[derive(Debug, Clone)]
pub struct Curves {
    /// The task.
    pub task: String,
    /// What stands on the vertical axis.
    pub what: &'static str,
    /// The picture.
    pub svg: String,
}

/// One method's line: (environment steps, mean, lowest, highest) over its seeds.
type Line = Vec<(f64, f64, f64, f64)>;

/// Every task's returns, and its success where it has some.
///
/// # Errors
/// The picture cannot be drawn.
pub fn curves(results: &Results) -> anyhow::Result<Vec<Curves>> {
    let mut curves = Vec::new();
    for task in &results.tasks {
        let of_return: fn(&EvaluationRow) -> Option<f64> = |row| Some(row.return_mean);
        let of_success: fn(&EvaluationRow) -> Option<f64> = |row| row.success_rate;
        for (what, of) in [("evaluation return", of_return), ("success rate", of_success)] {
            let lines: Vec<(usize, &str, Line)> = results
                .methods
                .iter()
                .enumerate()
                .map(|(index, method)| {
                    let begun = |run: &&Run| !run.rows.is_empty();
                    let runs: Vec<&Run> = results.of(task, method).filter(begun).collect();
                    (index, method.as_str(), line(&runs, of))
                })
                .filter(|(_, _, line)| !line.is_empty())
                .collect();
            if lines.is_empty() {
                continue;
            }
            let svg = draw(task, what, &lines)
                .map_err(|error| anyhow!("cannot draw the curves of {task}: {error}"))?;
            curves.push(Curves { task: task.clone(), what, svg });
        }
    }
    Ok(curves)
}

/// The n-th evaluation of each seed belongs together: all are made after the same steps but for
/// the rest of a segment. A line ends where the first seed's does, so no mean changes its members.
fn line(runs: &[&Run], of: fn(&EvaluationRow) -> Option<f64>) -> Line {
    let rows = runs.iter().map(|run| run.rows.len()).min().unwrap_or(0);
    let at = |index: usize| {
        let values: Option<Vec<f64>> = runs.iter().map(|run| of(&run.rows[index])).collect();
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

fn colour(index: usize, method: &str) -> RGBColor {
    let known = KNOWN.iter().position(|known| *known == method);
    COLOURS[known.unwrap_or(index) % COLOURS.len()]
}

fn draw(
    task: &str,
    what: &str,
    lines: &[(usize, &str, Line)],
) -> Result<String, Box<dyn std::error::Error>> {
    let points = || lines.iter().flat_map(|(_, _, line)| line);
    let steps_max = points().map(|point| point.0).fold(1.0, f64::max);
    let low = points().map(|point| point.2).fold(f64::INFINITY, f64::min);
    let high = points().map(|point| point.3).fold(f64::NEG_INFINITY, f64::max);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        let mut chart = Axes { title: task, what, steps_max, values: low..high }.draw(&area)?;
        for (index, method, line) in lines {
            draw_line(&mut chart, colour(*index, method), method, line)?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .legend_area_size(30)
            .margin(14)
            .background_style(WHITE.mix(0.85))
            .border_style(BLACK.mix(0.2))
            .label_font(("sans-serif", 14))
            .draw()?;
        area.present()?;
    }
    Ok(svg)
}

fn draw_line(
    chart: &mut Chart<'_, '_>,
    colour: RGBColor,
    method: &str,
    line: &Line,
) -> Result<(), Box<dyn std::error::Error>> {
    let above = line.iter().map(|&(steps, _, _, high)| (steps, high));
    let below = line.iter().rev().map(|&(steps, _, low, _)| (steps, low));
    let band: Vec<_> = above.chain(below).collect();
    chart.draw_series(std::iter::once(Polygon::new(band, colour.mix(0.15))))?;
    let mean = line.iter().map(|&(steps, mean, _, _)| (steps, mean));
    let series = chart.draw_series(LineSeries::new(mean, colour.stroke_width(2)))?;
    series
        .label(method)
        .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 20, y)], colour.stroke_width(2)));
    Ok(())
}
