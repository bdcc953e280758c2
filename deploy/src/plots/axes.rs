//! What every learning curve stands on: the two axes, their labels and a light grid.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use crate::terminal::grouped;

/// Share of the spread left free above and below.
const MARGIN: f64 = 0.05;

/// A drawing over environment steps.
pub(crate) type Chart<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// What the axes are to show.
pub(crate) struct Axes<'t> {
    /// Above the picture.
    pub(crate) title: &'t str,
    /// Beside the vertical axis.
    pub(crate) what: &'t str,
    /// Environment steps, from 0.
    pub(crate) steps_max: f64,
    /// The lowest and the highest value.
    pub(crate) values: Range<f64>,
    /// Left free to the right of them.
    pub(crate) beside: u32,
}

impl Axes<'_> {
    /// Draws them.
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
            .margin_right(self.beside)
            .x_label_area_size(44)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..self.steps_max, (low - margin)..(high + margin))?;
        chart
            .configure_mesh()
            .x_desc("environment steps")
            .y_desc(self.what)
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

/// `-4`, `-4.5`: no digits that say nothing.
fn tick(value: f64) -> String {
    // Adding zero turns -0 into 0.
    format!("{}", (value * 1e3).round() / 1e3 + 0.0)
}
