//! Lays out panels side by side, with a title above, a label of the vertical axis to the left and
//! a legend to the right.

use std::error::Error;

use plotters::coord::Shift;
use plotters::prelude::*;

/// Colour of text.
pub(super) const INK: RGBAColor = RGBAColor(0, 0, 0, 0.85);
/// Distance between two lines of the legend.
pub(super) const LINE_HEIGHT: i32 = 22;
/// Space for the title.
const TITLE_HEIGHT: u32 = 44;
/// Space for the label of the vertical axis.
const Y_LABEL_WIDTH: u32 = 34;

/// A part of an SVG picture.
pub(super) type Area<'b> = DrawingArea<SVGBackend<'b>, Shift>;

/// Sizes of a picture with panels.
pub(super) struct PanelLayout {
    /// Maximum number of panels in a row.
    pub(super) columns_max: usize,
    /// Size of a panel, including its labels.
    pub(super) panel: (u32, u32),
    /// Space below all panels.
    pub(super) bottom_height: u32,
    /// Space for the legend.
    pub(super) legend_width: u32,
}

/// A picture whose panels and legend are to be drawn.
pub(super) struct Panels<'a, 'b> {
    /// The whole picture.
    pub(super) area: &'a Area<'b>,
    /// One part for each panel, row by row.
    pub(super) cells: Vec<Area<'b>>,
    /// Number of panels in a row.
    pub(super) columns: usize,
    /// Upper left corner of the legend.
    pub(super) legend: [i32; 2],
    /// Middle of the space below all panels.
    pub(super) bottom: [i32; 2],
}

impl PanelLayout {
    /// Draws a picture with `count` panels, which `draw` fills, as SVG.
    pub(super) fn draw(
        &self,
        title: &str,
        y_label: &str,
        count: usize,
        draw: impl FnOnce(&Panels<'_, '_>) -> Result<(), Box<dyn Error>>,
    ) -> Result<String, Box<dyn Error>> {
        let columns = count.clamp(1, self.columns_max);
        let rows = count.div_ceil(columns);
        let (width, height) = (self.panel.0 * columns as u32, self.panel.1 * rows as u32);
        let size =
            (Y_LABEL_WIDTH + width + self.legend_width, TITLE_HEIGHT + height + self.bottom_height);
        let mut svg = String::new();
        {
            let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
            area.fill(&WHITE)?;
            let large = ("sans-serif", 20).into_font().color(&INK);
            area.draw_text(title, &large, ((Y_LABEL_WIDTH + 16) as i32, 10))?;
            let upright =
                ("sans-serif", 16).into_font().transform(FontTransform::Rotate270).color(&INK);
            area.draw_text(y_label, &upright, (10, (TITLE_HEIGHT + height / 2 + 50) as i32))?;
            let inner =
                area.margin(TITLE_HEIGHT, self.bottom_height, Y_LABEL_WIDTH, self.legend_width);
            let right = (Y_LABEL_WIDTH + width + 16) as i32;
            let below = (TITLE_HEIGHT + height + 10) as i32;
            draw(&Panels {
                area: &area,
                cells: inner.split_evenly((rows, columns)),
                columns,
                legend: [right, (TITLE_HEIGHT + 12) as i32],
                bottom: [(Y_LABEL_WIDTH + width / 2) as i32, below],
            })?;
            area.present()?;
        }
        Ok(svg)
    }
}

/// Draws text of a size [pixel].
pub(super) fn write(
    area: &Area<'_>,
    text: &str,
    size: u32,
    [x, y]: [i32; 2],
) -> Result<(), Box<dyn Error>> {
    Ok(area.draw_text(text, &("sans-serif", size).into_font().color(&INK), (x, y))?)
}
