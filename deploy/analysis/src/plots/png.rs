//! Converts an SVG to PNG, for slides, chats and viewers without SVG.

use anyhow::{Context, anyhow};
use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree};

/// Font under Apache-2.0, see the README next to it. With a bundled font the pictures are the same
/// on every machine, even without installed fonts.
const FONT: &[u8] = include_bytes!("roboto/Roboto-Regular.ttf");
const FAMILY: &str = "Roboto";
/// Pixels per unit of the SVG, for high-resolution screens and print.
const SCALE: f32 = 2.0;

/// Renders an SVG of this program.
///
/// # Errors
/// The text is not an SVG, or has no size.
pub(crate) fn png(svg: &str) -> anyhow::Result<Vec<u8>> {
    let mut options = Options { font_family: FAMILY.to_owned(), ..Options::default() };
    let fonts = options.fontdb_mut();
    fonts.load_font_data(FONT.to_vec());
    // The generic family that our pictures use.
    fonts.set_sans_serif_family(FAMILY);
    let tree = Tree::from_str(svg, &options).context("cannot render an SVG")?;
    let size = tree.size().to_int_size().scale_by(SCALE);
    let mut pixels = size
        .and_then(|size| Pixmap::new(size.width(), size.height()))
        .ok_or_else(|| anyhow!("an SVG has no size"))?;
    resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut pixels.as_mut());
    pixels.encode_png().context("cannot write a PNG")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Renders `text` in black on white.
    fn drawn(text: &str) -> Pixmap {
        let svg = format!(
            "<svg width='200' height='40' xmlns='http://www.w3.org/2000/svg'>\
             <rect width='200' height='40' fill='white'/>\
             <text x='10' y='30' font-family='sans-serif' font-size='24'>{text}</text></svg>"
        );
        Pixmap::decode_png(&png(&svg).unwrap()).unwrap()
    }

    fn dark(pixels: &Pixmap) -> usize {
        pixels.pixels().iter().filter(|pixel| pixel.red() < 128).count()
    }

    #[test]
    fn text_is_drawn_with_the_font_that_the_program_carries() {
        let empty = drawn("");
        assert_eq!((empty.width(), empty.height()), (400, 80));
        assert_eq!(dark(&empty), 0);
        // Two letters have twice as many dark pixels, except for partly covered ones.
        let (one, two) = (dark(&drawn("H")), dark(&drawn("HH")));
        assert!(one > 100 && two.abs_diff(2 * one) < one / 5, "{one} {two}");
        // Characters used in figures and units.
        let missing = dark(&drawn("\u{1F600}"));
        for sign in ["−", "±", "²", "³", "°", "Δ", "≥", "–", "·", "é", "ж"] {
            let drawn = dark(&drawn(sign));
            assert!(drawn > 0 && drawn != missing, "{sign} is not in the font");
        }
    }

    #[test]
    fn a_text_that_is_not_an_svg_is_refused() {
        assert!(png("<p>").is_err());
    }
}
