//! Draws the learning curve of a run: evaluation return over environment steps, as mean and
//! standard deviation over episodes.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use dmprl_run::RunDirectory;
use dmprl_run::format::std_of;
use dmprl_shared::supervision::EvaluationRow;
use plotters::prelude::*;

use super::axes::Axes;
use super::png::png;

/// Blue of the Okabe-Ito palette.
const BLUE: RGBColor = RGBColor(0, 114, 178);
/// Size of the picture in pixels.
const SIZE: (u32, u32) = (800, 480);
/// Space to the right of the chart, for half of the last tick label.
const RIGHT_MARGIN: u32 = 40;

/// Draws `plots/learning_curve.svg` and a PNG of it; returns `None` without evaluations.
///
/// - `title`: title above the curve.
///
/// # Errors
/// The rows cannot be read, or the picture cannot be written.
pub fn learning_curve(run: &RunDirectory, title: &str) -> anyhow::Result<Option<PathBuf>> {
    let rows = run.evaluations()?;
    if rows.is_empty() {
        return Ok(None);
    }
    let svg =
        draw(&rows, title).map_err(|error| anyhow!("cannot draw the learning curve: {error}"))?;
    let path = run.path().join("plots").join("learning_curve.svg");
    let pictures = [(path.with_extension("png"), png(&svg)?), (path.clone(), svg.into_bytes())];
    for (path, picture) in pictures {
        std::fs::write(&path, picture)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(Some(path))
}

fn draw(rows: &[EvaluationRow], title: &str) -> Result<String, Box<dyn std::error::Error>> {
    let points: Vec<(f64, f64, f64)> = rows
        .iter()
        .map(|row| (row.env_steps as f64, row.return_mean, std_of(&row.returns)))
        .collect();
    let steps_max = points.iter().map(|point| point.0).fold(1.0, f64::max);
    let low = points.iter().map(|point| point.1 - point.2).fold(f64::INFINITY, f64::min);
    let high = points.iter().map(|point| point.1 + point.2).fold(f64::NEG_INFINITY, f64::max);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        let axes = Axes {
            title,
            y_label: "evaluation return",
            steps_max,
            values: low..high,
            right_margin: RIGHT_MARGIN,
        };
        let mut chart = axes.draw(&area)?;
        let above = points.iter().map(|&(steps, mean, std)| (steps, mean + std));
        let below = points.iter().rev().map(|&(steps, mean, std)| (steps, mean - std));
        let band: Vec<_> = above.chain(below).collect();
        chart.draw_series(std::iter::once(Polygon::new(band, BLUE.mix(0.2))))?;
        let mean = points.iter().map(|&(steps, mean, _)| (steps, mean));
        chart.draw_series(LineSeries::new(mean.clone(), BLUE.stroke_width(2)))?;
        chart.draw_series(mean.map(|point| Circle::new(point, 3, BLUE.filled())))?;
        let note = format!("mean ± 1 std over {} episodes", rows[0].returns.len());
        let style = ("sans-serif", 14).into_font().color(&BLUE);
        // At the lower right, below a rising curve.
        area.draw_text(&note, &style, (SIZE.0 as i32 - 250, SIZE.1 as i32 - 90))?;
        area.present()?;
    }
    Ok(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(env_steps: u64, returns: &[f64]) -> EvaluationRow {
        EvaluationRow {
            env_steps,
            updates: 0,
            segments: 0,
            wall_s: 0.0,
            policy_version: 1,
            returns: returns.to_vec(),
            return_mean: returns.iter().sum::<f64>() / returns.len() as f64,
            success_rate: None,
            smoothness: 0.0,
            at_bounds: None,
        }
    }

    #[test]
    fn picture_has_labelled_axes_and_one_dot_per_evaluation() {
        let rows = [row(0, &[-12.0, -8.0]), row(5_000, &[-7.0, -6.0]), row(10_000, &[-5.0, -5.0])];
        let svg = draw(&rows, "reacher").unwrap();
        for text in ["environment steps", "evaluation return", "reacher", "10,000", "± 1 std"] {
            assert!(svg.contains(text), "{text} is missing");
        }
        assert_eq!(svg.matches("<circle").count(), rows.len());
        assert_eq!(svg.matches("<polygon").count(), 1);
    }

    #[test]
    fn single_evaluation_without_spread_is_drawn() {
        let svg = draw(&[row(0, &[0.0])], "one").unwrap();
        assert_eq!(svg.matches("<circle").count(), 1);
    }
}
