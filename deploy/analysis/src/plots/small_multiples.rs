//! Draws small multiples: panels side by side with the same axes, for comparison.

use plotters::prelude::*;

/// Maximum number of panels in a row.
const COLUMNS_MAX: usize = 4;
/// Size of a panel, including its labels.
const PANEL: (u32, u32) = (270, 210);
/// Space for the title above all panels.
const TITLE_HEIGHT: u32 = 44;
/// Space for the label of the horizontal axis below all panels.
const X_LABEL_HEIGHT: u32 = 40;
/// Space for the label of the vertical axis.
const Y_LABEL_WIDTH: u32 = 34;
/// Space for the legend.
const LEGEND_WIDTH: u32 = 190;
/// Distance between two lines of the legend.
const LINE_HEIGHT: i32 = 22;
/// Margin above and below the values, as a fraction of their range.
const MARGIN: f64 = 0.05;
const INK: RGBAColor = RGBAColor(0, 0, 0, 0.85);
/// Tol's "bright" scheme, distinguishable with all common types of colour vision and different from
/// the methods' colours. The grey is darker here, for a white background.
const COLOURS: [RGBColor; 7] = [
    RGBColor(68, 119, 170),
    RGBColor(238, 102, 119),
    RGBColor(34, 136, 51),
    RGBColor(204, 187, 68),
    RGBColor(102, 204, 238),
    RGBColor(170, 51, 119),
    RGBColor(120, 120, 120),
];

/// A panel.
pub(crate) struct Panel {
    /// Title above the panel.
    pub(crate) title: String,
    /// Colour that marks the panel.
    pub(crate) colour: RGBColor,
    /// Points (x, y) of each line.
    pub(crate) lines: Vec<Vec<(f64, f64)>>,
}

/// Which axes of a panel have tick labels: only those at the border of the figure.
#[derive(Debug, Clone, Copy)]
struct TickLabels {
    x: bool,
    y: bool,
}

/// A figure with several panels.
pub(crate) struct SmallMultiples<'t> {
    /// Title above all panels.
    pub(crate) title: &'t str,
    /// Labels of the horizontal and the vertical axis, with units.
    pub(crate) axes: [&'t str; 2],
    /// Names of the lines, the same in each panel.
    pub(crate) names: &'t [String],
    /// Panels, at least one with a point.
    pub(crate) panels: Vec<Panel>,
}

impl SmallMultiples<'_> {
    /// Draws the figure as SVG.
    pub(crate) fn draw(&self) -> Result<String, Box<dyn std::error::Error>> {
        let columns = self.panels.len().clamp(1, COLUMNS_MAX);
        let rows = self.panels.len().div_ceil(columns);
        let inner = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
        let size =
            (Y_LABEL_WIDTH + inner.0 + LEGEND_WIDTH, TITLE_HEIGHT + inner.1 + X_LABEL_HEIGHT);
        let mut svg = String::new();
        {
            let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
            area.fill(&WHITE)?;
            let words = |text: &str, points: u32, at: (u32, u32)| {
                let style = ("sans-serif", points).into_font().color(&INK);
                area.draw_text(text, &style, (at.0 as i32, at.1 as i32))
            };
            words(self.title, 20, (Y_LABEL_WIDTH + 16, 10))?;
            let below = TITLE_HEIGHT + inner.1 + 10;
            words(self.axes[0], 16, (Y_LABEL_WIDTH + inner.0 / 2, below))?;
            let upright =
                ("sans-serif", 16).into_font().transform(FontTransform::Rotate270).color(&INK);
            let middle = (TITLE_HEIGHT + inner.1 / 2 + 60) as i32;
            area.draw_text(self.axes[1], &upright, (10, middle))?;
            let panels = area.margin(TITLE_HEIGHT, X_LABEL_HEIGHT, Y_LABEL_WIDTH, LEGEND_WIDTH);
            let cells = panels.split_evenly((rows, columns));
            for (index, (panel, cell)) in self.panels.iter().zip(&cells).enumerate() {
                let tick_labels =
                    TickLabels { x: index + columns >= self.panels.len(), y: index % columns == 0 };
                self.draw_panel(cell, panel, tick_labels)?;
            }
            let x = (Y_LABEL_WIDTH + inner.0 + 16) as i32;
            for (index, name) in self.names.iter().enumerate() {
                let y = (TITLE_HEIGHT + 12) as i32 + index as i32 * LINE_HEIGHT;
                let stroke = vec![(x, y + 7), (x + 22, y + 7)];
                area.draw(&PathElement::new(stroke, line_colour(index).stroke_width(3)))?;
                words(name, 14, ((x + 28) as u32, y as u32))?;
            }
            area.present()?;
        }
        Ok(svg)
    }

    fn draw_panel<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, plotters::coord::Shift>,
        panel: &Panel,
        tick_labels: TickLabels,
    ) -> Result<(), Box<dyn std::error::Error>>
    where
        DB::ErrorType: 'static,
    {
        let [x, y] = self.ranges();
        let mut chart = ChartBuilder::on(area)
            .margin(8)
            .margin_top(26)
            .x_label_area_size(22)
            .y_label_area_size(44)
            .build_cartesian_2d(x, y)?;
        let tick = |shown: bool, value: f64| {
            let rounded = (value * 1e3).round() / 1e3 + 0.0;
            if shown { format!("{rounded}") } else { String::new() }
        };
        chart
            .configure_mesh()
            .x_labels(4)
            .y_labels(5)
            .x_label_formatter(&|value| tick(tick_labels.x, *value))
            .y_label_formatter(&|value| tick(tick_labels.y, *value))
            .label_style(("sans-serif", 13))
            .light_line_style(WHITE)
            .bold_line_style(BLACK.mix(0.12))
            .draw()?;
        for (index, line) in panel.lines.iter().enumerate() {
            let stroke = line_colour(index).stroke_width(2);
            chart.draw_series(LineSeries::new(line.iter().copied(), stroke))?;
        }
        let style = ("sans-serif", 15).into_font().color(&INK);
        area.draw(&Rectangle::new([(52, 9), (64, 21)], panel.colour.filled()))?;
        area.draw_text(&panel.title, &style, (70, 7))?;
        Ok(())
    }

    /// Returns the ranges of both axes over all panels.
    fn ranges(&self) -> [std::ops::Range<f64>; 2] {
        let points = || self.panels.iter().flat_map(|panel| panel.lines.iter().flatten());
        let over = |of: fn(&(f64, f64)) -> f64| {
            let low = points().map(of).fold(f64::INFINITY, f64::min);
            let high = points().map(of).fold(f64::NEG_INFINITY, f64::max);
            (low, high)
        };
        let (first, last) = over(|point| point.0);
        let (low, high) = over(|point| point.1);
        let margin = ((high - low) * MARGIN).max(1e-3);
        [first..last.max(first + 1e-3), (low - margin)..(high + margin)]
    }
}

fn line_colour(index: usize) -> RGBColor {
    COLOURS[index % COLOURS.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panels_share_axes_and_legend() {
        let panel = |title: &str, top: f64| Panel {
            title: title.to_owned(),
            colour: RGBColor(0, 114, 178),
            lines: vec![vec![(0.0, 0.0), (1.0, top)], vec![(0.0, 0.1), (1.0, 0.2)]],
        };
        let names = ["shoulder".to_owned(), "elbow".to_owned()];
        let multiples = SmallMultiples {
            title: "reacher",
            axes: ["time [s]", "joint position [rad]"],
            names: &names,
            panels: (0..5).map(|index| panel(&format!("m{index}"), f64::from(index))).collect(),
        };
        let [x, y] = multiples.ranges();
        assert_eq!((x.start, x.end), (0.0, 1.0));
        assert!((y.start + 0.2).abs() < 1e-9 && (y.end - 4.2).abs() < 1e-9, "{y:?}");
        let svg = multiples.draw().unwrap();
        for text in ["reacher", "time [s]", "joint position [rad]", "m0", "m4"] {
            assert!(svg.contains(text), "{text} is missing");
        }
        for name in &names {
            assert_eq!(svg.matches(name.as_str()).count(), 1);
        }
    }
}
