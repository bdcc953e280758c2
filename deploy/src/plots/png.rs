//! A picture's SVG as PNG, for slides, chats and viewers that draw no SVG.

use anyhow::{Context, anyhow};
use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree};

/// Apache-2.0, see the README beside it. With a font of ours the same runs give the same picture on
/// every machine, also where no font is installed.
const FONT: &[u8] = include_bytes!("roboto/Roboto-Regular.ttf");
const FAMILY: &str = "Roboto";
/// Pixels a unit of the SVG: sharp on a screen of high resolution and in print.
const SCALE: f32 = 2.0;

/// Draws an SVG of ours.
///
/// # Errors
/// It is no SVG, or has no size.
pub(crate) fn png(svg: &str) -> anyhow::Result<Vec<u8>> {
    let mut options = Options { font_family: FAMILY.to_owned(), ..Options::default() };
    let fonts = options.fontdb_mut();
    fonts.load_font_data(FONT.to_vec());
    // What our pictures ask for.
    fonts.set_sans_serif_family(FAMILY);
    let tree = Tree::from_str(svg, &options).context("no picture can be made of an SVG")?;
    let size = tree.size().to_int_size().scale_by(SCALE);
    let mut pixels = size
        .and_then(|size| Pixmap::new(size.width(), size.height()))
        .ok_or_else(|| anyhow!("an SVG of no size"))?;
    resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut pixels.as_mut());
    pixels.encode_png().context("cannot write a PNG")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// White, with `text` in black.
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
        // Twice as many dark pixels for two letters, but for those that a stroke half covers.
        let (one, two) = (dark(&drawn("H")), dark(&drawn("HH")));
        assert!(one > 100 && two.abs_diff(2 * one) < one / 5, "{one} {two}");
        // Signs that figures and units are written with.
        let missing = dark(&drawn("\u{1F600}"));
        for sign in ["−", "±", "²", "³", "°", "Δ", "≥", "–", "·", "é", "ж"] {
            let drawn = dark(&drawn(sign));
            assert!(drawn > 0 && drawn != missing, "{sign} is not in the font");
        }
    }

    #[test]
    fn what_is_no_svg_is_refused() {
        assert!(png("<p>").is_err());
    }
}
