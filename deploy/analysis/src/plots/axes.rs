//! Draws the axes of a learning curve, with labels and a light grid.

use std::ops::Range;

use dmprl_run::format::grouped;
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// Margin above and below the values, as a fraction of their range.
const MARGIN: f64 = 0.05;

/// A chart with numbers on both axes.
pub(crate) type Chart<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Labels and ranges of the axes.
pub(crate) struct Axes<'t> {
    /// Title above the chart.
    pub(crate) title: &'t str,
    /// Label of the vertical axis.
    pub(crate) y_label: &'t str,
    /// Maximum of the environment steps. The axis starts at 0.
    pub(crate) steps_max: f64,
    /// Minimum and maximum of the values.
    pub(crate) values: Range<f64>,
    /// Space to the right of the chart, in pixels.
    pub(crate) right_margin: u32,
}

impl Axes<'_> {
    /// Draws the axes.
    pub(crate) fn draw<'a, 'b>(
        &self,
        area: &'a DrawingArea<SVGBackend<'b>, Shift>,
    ) -> Result<Chart<'a, 'b>, Box<dyn std::error::Error>> {
        let Range { start: low, end: high } = self.values;
        let margin = ((high - low) * MARGIN).max(1e-3);
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(area)
            .caption(self.title, ("sans-serif", 20))
            .margin(16)
            .margin_right(self.right_margin)
            .x_label_area_size(44)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..self.steps_max, (low - margin)..(high + margin))?;
        chart
            .configure_mesh()
            .x_desc("environment steps")
            .y_desc(self.y_label)
            .x_label_formatter(&|steps| grouped(steps.round() as u64))
            .y_label_formatter(&|value| tick(*value))
            .label_style(("sans-serif", 14))
            .axis_desc_style(("sans-serif", 16))
            .light_line_style(WHITE)
            .bold_line_style(BLACK.mix(0.12))
            .draw()?;
        Ok(chart)
    }
}

/// Formats a tick label, such as `-4` or `-4.5`, without trailing zeros.
fn tick(value: f64) -> String {
    // Adding zero turns -0 into 0.
    format!("{}", (value * 1e3).round() / 1e3 + 0.0)
}
