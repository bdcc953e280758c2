//! The colours of methods, which are the same in every picture.

use plotters::style::RGBColor;

/// Palette of Okabe and Ito, distinguishable with all common types of colour vision. The yellow is
/// darker here, for a white background.
const COLOURS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
    RGBColor(150, 140, 0),
];
/// Methods with a fixed colour, in the order of the colours.
const KNOWN: [&str; 8] =
    ["DDPG-DMP", "DDPG-DMP (paper)", "TD3-DMP", "SAC-DMP", "DDPG", "TD3", "SAC", "NDP"];

/// Returns the index of a method's fixed colour, if it has one.
fn known(method: &str) -> Option<usize> {
    KNOWN.iter().position(|known| *known == method)
}

/// Returns true if a method has a fixed colour.
#[must_use]
pub fn has_colour(method: &str) -> bool {
    known(method).is_some()
}

/// Returns the colours of a picture's methods, which differ as long as there are enough of them.
#[must_use]
pub(crate) fn palette(methods: &[&str]) -> Vec<RGBColor> {
    let taken: Vec<usize> = methods.iter().filter_map(|method| known(method)).collect();
    let mut free = (0..COLOURS.len()).filter(|index| !taken.contains(index)).chain(0..);
    methods
        .iter()
        .map(|method| known(method).or_else(|| free.next()).unwrap_or(0))
        .map(|index| COLOURS[index % COLOURS.len()])
        .collect()
}

/// Returns the colour of a method.
///
/// - `index`: index of the method in the report, which selects the colour if it has no fixed one.
#[must_use]
pub fn colour(index: usize, method: &str) -> RGBColor {
    COLOURS[known(method).unwrap_or(index) % COLOURS.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_of_a_picture_have_different_colours() {
        let colours = palette(&["A", "B", "TD3-DMP", "C", "DDPG-DMP"]);
        assert_eq!((colours[2], colours[4]), (COLOURS[2], COLOURS[0]));
        let distinct: std::collections::BTreeSet<_> =
            colours.iter().map(|colour| (colour.0, colour.1, colour.2)).collect();
        assert_eq!(distinct.len(), colours.len());
        assert_eq!(palette(&["A"; 20]).len(), 20);
    }
}
