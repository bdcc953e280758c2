//! Formats numbers for people.

use std::path::Path;
use std::time::Duration;

use indicatif::{BinaryBytes, HumanCount};

/// Formats `1234567` as `1,234,567`.
#[must_use]
pub fn grouped(number: u64) -> String {
    HumanCount(number).to_string()
}

/// Formats a duration as `42 s`, `3 min 05 s`, `2 h 07 min`.
#[must_use]
pub fn duration(duration: Duration) -> String {
    let seconds = duration.as_secs();
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3_600 => format!("{} min {:02} s", seconds / 60, seconds % 60),
        _ => format!("{} h {:02} min", seconds / 3_600, seconds / 60 % 60),
    }
}

/// Formats bytes as `640 B`, `64 MiB` or `3.20 MiB`: binary units, as in Docker and `ulimit`.
#[must_use]
pub fn binary_bytes(bytes: u64) -> String {
    BinaryBytes(bytes).to_string().replace(".00 ", " ")
}

/// Formats a path relative to the working directory if it is inside it.
#[must_use]
pub fn shown(path: &Path) -> String {
    let here = std::env::current_dir().unwrap_or_default();
    path.strip_prefix(here).unwrap_or(path).display().to_string()
}

/// Population standard deviation of the values; 0 without values.
#[must_use]
pub fn std_of(values: &[f64]) -> f64 {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Formats mean and standard deviation as `-4.41 ± 1.02`.
#[must_use]
pub fn plus_minus(values: &[f64]) -> String {
    let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
    format!("{mean:.2} ± {:.2}", std_of(values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_grouped_by_thousands() {
        for (number, text) in [(0, "0"), (999, "999"), (1_000, "1,000"), (1_234_567, "1,234,567")] {
            assert_eq!(grouped(number), text);
        }
    }

    #[test]
    fn bytes_have_the_largest_unit_that_fits() {
        for (bytes, text) in
            [(0, "0 B"), (1_023, "1023 B"), (1_536, "1.50 KiB"), (64 << 20, "64 MiB")]
        {
            assert_eq!(binary_bytes(bytes), text);
        }
    }

    #[test]
    fn durations_use_two_units_at_most() {
        for (seconds, text) in [(59, "59 s"), (185, "3 min 05 s"), (7_620, "2 h 07 min")] {
            assert_eq!(duration(Duration::from_secs(seconds)), text);
        }
    }

    #[test]
    fn spread_is_the_population_standard_deviation() {
        assert_eq!(std_of(&[]), 0.0);
        assert_eq!(std_of(&[1.0, 3.0]), 1.0);
        assert_eq!(plus_minus(&[1.0, 3.0]), "2.00 ± 1.00");
    }
}
