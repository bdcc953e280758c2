//! Converts SVG to PNG, for slides, chats and viewers that do not support SVG.

use anyhow::{Context, anyhow};
use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree};

/// Bundled font, so that pictures are the same on every machine. It is under Apache-2.0; see the
/// README next to it.
const FONT: &[u8] = include_bytes!("roboto/Roboto-Regular.ttf");
const FAMILY: &str = "Roboto";
/// Pixels per SVG unit, for high-resolution screens and print.
const SCALE: f32 = 2.0;

/// Renders an SVG that this program has drawn.
///
/// # Errors
/// The text is not an SVG, or the SVG has no size.
pub(crate) fn png(svg: &str) -> anyhow::Result<Vec<u8>> {
    let mut options = Options { font_family: FAMILY.to_owned(), ..Options::default() };
    let fonts = options.fontdb_mut();
    fonts.load_font_data(FONT.to_vec());
    // The pictures name the generic family only.
    fonts.set_sans_serif_family(FAMILY);
    let tree = Tree::from_str(svg, &options).context("cannot render an SVG")?;
    let size = tree.size().to_int_size().scale_by(SCALE);
    let mut pixels = size
        .and_then(|size| Pixmap::new(size.width(), size.height()))
        .ok_or_else(|| anyhow!("an SVG has no size"))?;
    resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut pixels.as_mut());
    pixels.encode_png().context("cannot encode a PNG")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Renders `text` in black on white.
    fn rendered(text: &str) -> Pixmap {
        let svg = format!(
            "<svg width='200' height='40' xmlns='http://www.w3.org/2000/svg'>\
             <rect width='200' height='40' fill='white'/>\
             <text x='10' y='30' font-family='sans-serif' font-size='24'>{text}</text></svg>"
        );
        Pixmap::decode_png(&png(&svg).unwrap()).unwrap()
    }

    fn dark_count(pixels: &Pixmap) -> usize {
        pixels.pixels().iter().filter(|pixel| pixel.red() < 128).count()
    }

    #[test]
    fn text_is_rendered_with_the_bundled_font() {
        let empty = rendered("");
        assert_eq!((empty.width(), empty.height()), (400, 80));
        assert_eq!(dark_count(&empty), 0);
        // Two letters have about twice as many dark pixels; partly covered ones vary.
        let (one, two) = (dark_count(&rendered("H")), dark_count(&rendered("HH")));
        assert!(one > 100 && two.abs_diff(2 * one) < one / 5, "{one} {two}");
        // Characters used in numbers and units, and of names.
        let missing = dark_count(&rendered("\u{1F600}"));
        for sign in ["−", "±", "²", "³", "°", "Δ", "≥", "–", "·", "é", "ж"] {
            let count = dark_count(&rendered(sign));
            assert!(count > 0 && count != missing, "{sign} is not in the font");
        }
    }

    #[test]
    fn text_that_is_not_svg_is_rejected() {
        assert!(png("<p>").is_err());
    }
}
