//! Draws scatter plots side by side with one vertical axis: a point with bars for each method, and
//! a line through the points that no other point beats in both directions.

use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// Maximum number of panels in a row.
const COLUMNS_MAX: usize = 2;
/// Size of a panel, including its labels.
const PANEL: (u32, u32) = (380, 280);
/// Space for the title above all panels.
const TITLE_HEIGHT: u32 = 44;
/// Space for the label of the vertical axis.
const Y_LABEL_WIDTH: u32 = 34;
/// Space for the legend.
const LEGEND_WIDTH: u32 = 250;
/// Distance between two lines of the legend.
const LINE_HEIGHT: i32 = 22;
/// Width of a letter of a label [pixel].
const LABEL_LETTER: i32 = 6;
/// Height of a label [pixel].
const LABEL_HEIGHT: i32 = 10;
/// Margin around the values, as a fraction of their range.
const MARGIN: f64 = 0.08;
const INK: RGBAColor = RGBAColor(0, 0, 0, 0.85);

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
        let columns = self.panels.len().clamp(1, COLUMNS_MAX);
        let rows = self.panels.len().div_ceil(columns);
        let inner = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
        let size = (Y_LABEL_WIDTH + inner.0 + LEGEND_WIDTH, TITLE_HEIGHT + inner.1);
        let mut svg = String::new();
        {
            let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
            area.fill(&WHITE)?;
            let title = ("sans-serif", 20).into_font().color(&INK);
            area.draw_text(self.title, &title, ((Y_LABEL_WIDTH + 16) as i32, 10))?;
            let upright =
                ("sans-serif", 16).into_font().transform(FontTransform::Rotate270).color(&INK);
            let middle = (TITLE_HEIGHT + inner.1 / 2 + 40) as i32;
            area.draw_text(self.y_label, &upright, (10, middle))?;
            let panels = area.margin(TITLE_HEIGHT, 0, Y_LABEL_WIDTH, LEGEND_WIDTH);
            for (panel, cell) in self.panels.iter().zip(&panels.split_evenly((rows, columns))) {
                draw_panel(cell, panel)?;
            }
            let x = (Y_LABEL_WIDTH + inner.0 + 16) as i32;
            for (index, (name, colour)) in self.legend.iter().enumerate() {
                let y = (TITLE_HEIGHT + 16) as i32 + index as i32 * LINE_HEIGHT;
                area.draw(&Circle::new((x + 6, y), 5, colour.filled()))?;
                let style = ("sans-serif", 14).into_font().color(&INK);
                area.draw_text(name, &style, (x + 20, y - 7))?;
            }
            area.present()?;
        }
        Ok(svg)
    }
}

fn draw_panel<DB: DrawingBackend>(
    area: &DrawingArea<DB, plotters::coord::Shift>,
    panel: &ScatterPanel,
) -> Result<(), Box<dyn std::error::Error>>
where
    DB::ErrorType: 'static,
{
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
fn draw_labels<DB: DrawingBackend>(
    chart: &mut ChartContext<'_, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>,
    points: &[ScatterPoint],
) -> Result<(), Box<dyn std::error::Error>>
where
    DB::ErrorType: 'static,
{
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
