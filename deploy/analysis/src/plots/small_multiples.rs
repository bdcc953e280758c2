//! Draws small multiples: panels side by side with the same axes, for comparison.

use plotters::prelude::*;

use super::panels::{Area, LINE_HEIGHT, PanelLayout, write};

const LAYOUT: PanelLayout =
    PanelLayout { columns_max: 4, panel: (270, 210), bottom_height: 40, legend_width: 190 };
/// Margin above and below the values, as a fraction of their range.
const MARGIN: f64 = 0.05;
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
        let count = self.panels.len();
        LAYOUT.draw(self.title, self.axes[1], count, |picture| {
            write(picture.area, self.axes[0], 16, picture.bottom)?;
            for (index, (panel, cell)) in self.panels.iter().zip(&picture.cells).enumerate() {
                let x = index + picture.columns >= count;
                let y = index % picture.columns == 0;
                self.draw_panel(cell, panel, TickLabels { x, y })?;
            }
            let [x, y] = picture.legend;
            for (index, (name, line)) in self.names.iter().zip(0..).enumerate() {
                let y = y + line * LINE_HEIGHT;
                let stroke = vec![(x, y + 7), (x + 22, y + 7)];
                let style = line_colour(index).stroke_width(3);
                picture.area.draw(&PathElement::new(stroke, style))?;
                write(picture.area, name, 14, [x + 28, y])?;
            }
            Ok(())
        })
    }

    fn draw_panel(
        &self,
        area: &Area<'_>,
        panel: &Panel,
        tick_labels: TickLabels,
    ) -> Result<(), Box<dyn std::error::Error>> {
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
        area.draw(&Rectangle::new([(52, 9), (64, 21)], panel.colour.filled()))?;
        write(area, &panel.title, 15, [70, 7])
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
