//! Draws learning curves: evaluation return or success rate over environment steps, with a line per
//! method.

use anyhow::anyhow;
use dmprl_run::safe_name;
use plotters::prelude::*;

use super::layout::Picture;
use super::measures::Measure;
use super::paper::reported;
use super::provenance::SoftwareCounts;
use super::results::Results;
use super::run::Run;
use super::statistics::range;
use crate::plots::{Axes, Chart};

/// Size of the plot with its axes, in pixels.
const SIZE: (u32, u32) = (760, 520);
/// Width of the legend without text, in pixels. The legend is to the right of the plot.
const LEGEND_MARGIN: u32 = 76;
/// Width of a letter in the legend, in pixels.
const LEGEND_LETTER: u32 = 7;
/// Maximum width of the legend, in pixels.
const LEGEND_MAX: u32 = 480;
/// Distance between two lines of the legend, in pixels.
const LINE_HEIGHT: i32 = 24;

/// A point of a method's line: mean and range over its seeds.
struct Point {
    env_steps: f64,
    mean: f64,
    low: f64,
    high: f64,
}

/// Learning curves, one per task and measure.
#[derive(Debug, Clone, Default)]
pub struct Curves {
    /// The success rate of each task, or the return if the task does not report it.
    pub main: Vec<Picture>,
    /// The return of tasks that report a success rate.
    pub others: Vec<Picture>,
}

impl Curves {
    /// Returns all pictures.
    pub fn all(&self) -> impl Iterator<Item = &Picture> {
        self.main.iter().chain(&self.others)
    }
}

/// Draws the return of each task, and the success rate if the task reports it.
///
/// # Errors
/// A picture cannot be drawn.
pub fn curves(results: &Results) -> anyhow::Result<Curves> {
    let mut curves = Curves::default();
    for task in &results.tasks {
        let success = curve(results, task, "success rate", Measure::Success)?;
        let returns = curve(results, task, "evaluation return", Measure::Return)?;
        if success.is_some() {
            curves.main.extend(success);
            curves.others.extend(returns);
        } else {
            curves.main.extend(returns);
        }
    }
    Ok(curves)
}

/// Draws the curves of a task; `None` if no run has the measure.
fn curve(
    results: &Results,
    task: &str,
    what: &str,
    measure: Measure,
) -> anyhow::Result<Option<Picture>> {
    let lines: Vec<MethodLine> = (results.shown_methods(task).into_iter())
        .map(|index| MethodLine::new(results, task, index, measure))
        .filter(|line| !line.points.is_empty())
        .collect();
    if lines.is_empty() {
        return Ok(None);
    }
    let svg = draw(task, what, &lines)
        .map_err(|error| anyhow!("cannot draw the curves of {task}: {error}"))?;
    let path = format!("curves/{}-{}", safe_name(task), what.replace(' ', "-"));
    let alt = format!("{task}: {what} over environment steps");
    Ok(Some(Picture { path, alt, svg }))
}

/// Averages the n-th evaluations of all seeds, which differ by less than a segment in their steps.
/// The line ends with the shortest run, so that all means are over the same seeds.
fn points(runs: &[&Run], measure: Measure) -> Vec<Point> {
    let rows = runs.iter().map(|run| run.rows.len()).min().unwrap_or(0);
    let at = |index: usize| {
        let values: Option<Vec<f64>> =
            runs.iter().map(|run| measure.of_row(&run.rows[index])).collect();
        let values = values?;
        let count = runs.len() as f64;
        let steps = runs.iter().map(|run| run.rows[index].env_steps as f64).sum::<f64>();
        let [low, high] = range(&values);
        Some(Point {
            env_steps: steps / count,
            mean: values.iter().sum::<f64>() / count,
            low,
            high,
        })
    };
    (0..rows).map_while(at).collect()
}

/// The line of a method, and its result in the paper.
struct MethodLine {
    label: String,
    colour: RGBColor,
    points: Vec<Point>,
    paper: Option<f64>,
}

impl MethodLine {
    /// Averages the finished runs of a method, because a seed that has just started would cut the
    /// line short. If there are none, averages the unfinished runs.
    ///
    /// - `index`: index of the method in the report.
    fn new(results: &Results, task: &str, index: usize, measure: Measure) -> Self {
        let method = &results.methods[index];
        let mut runs: Vec<&Run> = results.of(task, method).filter(|run| run.ended).collect();
        if runs.is_empty() {
            runs = results.of(task, method).filter(|run| !run.rows.is_empty()).collect();
        }
        let paper = measure.in_paper().and_then(|table| reported(table, task, method));
        let software = SoftwareCounts::of(runs.iter().copied());
        Self {
            label: format!("{method} · n = {}{}", runs.len(), software.mark()),
            colour: results.colours()[index],
            points: points(&runs, measure),
            paper: paper.map(|(mean, _)| mean),
        }
    }
}

fn draw(
    task: &str,
    y_label: &str,
    lines: &[MethodLine],
) -> Result<String, Box<dyn std::error::Error>> {
    let points = || lines.iter().flat_map(|line| &line.points);
    let papers = || lines.iter().filter_map(|line| line.paper);
    let steps_max = points().map(|point| point.env_steps).fold(1.0, f64::max);
    let low = points().map(|point| point.low).chain(papers()).fold(f64::INFINITY, f64::min);
    let high = points().map(|point| point.high).chain(papers()).fold(f64::NEG_INFINITY, f64::max);
    let mut svg = String::new();
    {
        let letters = lines.iter().map(|line| line.label.chars().count()).max().unwrap_or(0);
        let right_margin = (LEGEND_MARGIN + LEGEND_LETTER * letters as u32).min(LEGEND_MAX);
        let size = (SIZE.0 + right_margin, SIZE.1);
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let axes = Axes { title: task, y_label, steps_max, values: low..high, right_margin };
        let mut chart = axes.draw(&area)?;
        // Bands first: a band on top of a line would change the line's colour.
        for line in lines {
            draw_band(&mut chart, line)?;
        }
        for line in lines {
            draw_line(&mut chart, line)?;
        }
        let plotted = chart.plotting_area().get_pixel_range();
        let (right, top) = (plotted.0.end, plotted.1.start);
        for line in lines {
            if let Some(paper) = line.paper {
                let (_, y) = chart.backend_coord(&(steps_max, paper));
                area.draw(&triangle(right + 4, y, line.colour))?;
            }
        }
        let words = |text: &str, at: (i32, i32)| {
            let style = ("sans-serif", 14).into_font().color(&BLACK.mix(0.85));
            area.draw_text(text, &style, at)
        };
        let mut y = top + 4;
        for MethodLine { label, colour, .. } in lines {
            let stroke = vec![(right + 28, y + 7), (right + 50, y + 7)];
            area.draw(&PathElement::new(stroke, colour.stroke_width(3)))?;
            words(label, (right + 56, y))?;
            y += LINE_HEIGHT;
        }
        if papers().next().is_some() {
            area.draw(&triangle(right + 34, y + 7, RGBColor(90, 90, 90)))?;
            words("result in the paper", (right + 56, y))?;
        }
        area.present()?;
    }
    Ok(svg)
}

/// Returns a triangle that points left to (x, y).
fn triangle(x: i32, y: i32, colour: RGBColor) -> Polygon<(i32, i32)> {
    Polygon::new(vec![(x, y), (x + 10, y - 5), (x + 10, y + 5)], colour.filled())
}

/// Draws the band between the lowest and the highest seed.
fn draw_band(
    chart: &mut Chart<'_, '_>,
    line: &MethodLine,
) -> Result<(), Box<dyn std::error::Error>> {
    let above = line.points.iter().map(|point| (point.env_steps, point.high));
    let below = line.points.iter().rev().map(|point| (point.env_steps, point.low));
    let band: Vec<_> = above.chain(below).collect();
    chart.draw_series(std::iter::once(Polygon::new(band, line.colour.mix(0.12))))?;
    Ok(())
}

fn draw_line(
    chart: &mut Chart<'_, '_>,
    line: &MethodLine,
) -> Result<(), Box<dyn std::error::Error>> {
    let mean: Vec<_> = line.points.iter().map(|point| (point.env_steps, point.mean)).collect();
    let stroke = line.colour.stroke_width(2);
    chart.draw_series(LineSeries::new(mean.iter().copied(), stroke))?;
    if let [only] = mean.as_slice() {
        // A line with a single point is invisible.
        chart.draw_series(std::iter::once(Circle::new(*only, 3, line.colour.filled())))?;
    }
    Ok(())
}
