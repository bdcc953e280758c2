//! Draws scatter plots side by side with one vertical axis: a point with bars for each method, and
//! a line through the points that no other point beats in both directions.

use plotters::prelude::*;

use super::axes::Chart;
use super::panels::{Area, INK, LINE_HEIGHT, PanelLayout, write};

const LAYOUT: PanelLayout =
    PanelLayout { columns_max: 2, panel: (380, 280), bottom_height: 0, legend_width: 250 };
/// Width of a letter of a label [pixel].
const LABEL_LETTER: i32 = 6;
/// Height of a label [pixel].
const LABEL_HEIGHT: i32 = 10;
/// Margin around the values, as a fraction of their range.
const MARGIN: f64 = 0.08;

/// A value with its bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounded {
    /// The value.
    pub(crate) value: f64,
    /// Lower and upper bound.
    pub(crate) bounds: [f64; 2],
}

/// The point of a method.
#[derive(Debug, Clone)]
pub(crate) struct ScatterPoint {
    /// Number of the method. A line connects the points of a method.
    pub(crate) method: usize,
    /// Colour of the method.
    pub(crate) colour: RGBColor,
    /// Text beside the point, if any.
    pub(crate) label: String,
    /// Horizontal coordinate.
    pub(crate) x: Bounded,
    /// Vertical coordinate.
    pub(crate) y: Bounded,
}

/// A panel.
pub(crate) struct ScatterPanel {
    /// Label of the horizontal axis.
    pub(crate) x_label: String,
    /// Points, at least one.
    pub(crate) points: Vec<ScatterPoint>,
    /// Coordinates of the points that no other beats, in order.
    pub(crate) front: Vec<(f64, f64)>,
}

/// A figure with several panels.
pub(crate) struct Scatter<'t> {
    /// Title above all panels.
    pub(crate) title: &'t str,
    /// Label of the vertical axis.
    pub(crate) y_label: &'t str,
    /// Names and colours of the methods.
    pub(crate) legend: Vec<(&'t str, RGBColor)>,
    /// Panels, at least one.
    pub(crate) panels: Vec<ScatterPanel>,
}

impl Scatter<'_> {
    /// Draws the figure as SVG.
    pub(crate) fn draw(&self) -> Result<String, Box<dyn std::error::Error>> {
        LAYOUT.draw(self.title, self.y_label, self.panels.len(), |picture| {
            for (panel, cell) in self.panels.iter().zip(&picture.cells) {
                draw_panel(cell, panel)?;
            }
            let [x, y] = picture.legend;
            for ((name, colour), line) in self.legend.iter().zip(0..) {
                let y = y + line * LINE_HEIGHT;
                picture.area.draw(&Circle::new((x + 6, y + 7), 5, colour.filled()))?;
                write(picture.area, name, 14, [x + 20, y])?;
            }
            Ok(())
        })
    }
}

fn draw_panel(area: &Area<'_>, panel: &ScatterPanel) -> Result<(), Box<dyn std::error::Error>> {
    let range = |of: fn(&ScatterPoint) -> Bounded| {
        let bounds = || panel.points.iter().flat_map(move |point| of(point).bounds);
        let low = bounds().fold(f64::INFINITY, f64::min);
        let high = bounds().fold(f64::NEG_INFINITY, f64::max);
        let margin = ((high - low) * MARGIN).max(high.abs() * 1e-3).max(1e-9);
        (low - margin)..(high + margin)
    };
    let mut chart = ChartBuilder::on(area)
        .margin(8)
        .x_label_area_size(44)
        .y_label_area_size(50)
        .build_cartesian_2d(range(|point| point.x), range(|point| point.y))?;
    let tick = |value: f64| format!("{}", (value * 1e4).round() / 1e4 + 0.0);
    chart
        .configure_mesh()
        .x_labels(4)
        .y_labels(5)
        .x_desc(panel.x_label.as_str())
        .x_label_formatter(&|value| tick(*value))
        .y_label_formatter(&|value| tick(*value))
        .label_style(("sans-serif", 13))
        .axis_desc_style(("sans-serif", 14))
        .light_line_style(WHITE)
        .bold_line_style(BLACK.mix(0.12))
        .draw()?;
    chart.draw_series(LineSeries::new(
        panel.front.iter().copied(),
        BLACK.mix(0.35).stroke_width(2),
    ))?;
    for (index, ScatterPoint { method, colour, x, y, .. }) in panel.points.iter().enumerate() {
        let place = (x.value, y.value);
        let mut later = panel.points[index + 1..].iter();
        if let Some(next) = later.find(|other| other.method == *method) {
            let ends = vec![place, (next.x.value, next.y.value)];
            chart.draw_series([PathElement::new(ends, colour.mix(0.5).stroke_width(1))])?;
        }
        let bars = [
            x.bounds.map(|bound| (bound, y.value)).to_vec(),
            y.bounds.map(|bound| (x.value, bound)).to_vec(),
        ];
        let bars = bars.map(|ends| PathElement::new(ends, colour.mix(0.6).stroke_width(1)));
        chart.draw_series(bars)?;
        chart.draw_series([Circle::new(place, 4, colour.filled())])?;
    }
    draw_labels(&mut chart, &panel.points)
}

/// Draws the labels beside their points, without those that would cover another point or label.
fn draw_labels(
    chart: &mut Chart<'_, '_>,
    points: &[ScatterPoint],
) -> Result<(), Box<dyn std::error::Error>> {
    let place = |point: &ScatterPoint| (point.x.value, point.y.value);
    let mut taken: Vec<(i32, i32)> =
        points.iter().map(|point| chart.backend_coord(&place(point))).collect();
    for (index, point) in points.iter().enumerate() {
        let (x, y) = taken[index];
        let width = LABEL_LETTER * point.label.chars().count() as i32;
        let covers = |other: &(i32, i32)| {
            (x + 1..x + 7 + width).contains(&other.0) && (other.1 - y).abs() < LABEL_HEIGHT
        };
        if point.label.is_empty() || taken.iter().any(covers) {
            continue;
        }
        taken.extend([(x + 7, y - 1), (x + 7 + width / 2, y - 1), (x + 7 + width, y - 1)]);
        let style = ("sans-serif", 11).into_font().color(&INK);
        let text = Text::new(point.label.clone(), (7, -6), style);
        chart.draw_series([EmptyElement::at(place(point)) + text])?;
    }
    Ok(())
}
