//! Formats points in time, in UTC.

use std::time::{SystemTime, UNIX_EPOCH};

use jiff::Timestamp;

/// Returns the seconds since 1970.
#[must_use]
pub fn unix_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// Formats a time as `2026-01-31T23:59:58Z`.
#[must_use]
pub fn rfc3339(time: SystemTime) -> String {
    format(time, "%Y-%m-%dT%H:%M:%SZ")
}

/// Formats the current time as [`rfc3339`] does.
#[must_use]
pub fn now_rfc3339() -> String {
    rfc3339(SystemTime::now())
}

/// Formats a time as `20260131-235958`, for names that sort by time.
#[must_use]
pub fn compact(time: SystemTime) -> String {
    format(time, "%Y%m%d-%H%M%S")
}

/// Formats the current time as [`compact`] does.
#[must_use]
pub fn compact_now() -> String {
    compact(SystemTime::now())
}

fn format(time: SystemTime, format: &str) -> String {
    // A clock outside jiff's range is broken; 1970 makes that visible.
    Timestamp::try_from(time).unwrap_or(Timestamp::UNIX_EPOCH).strftime(format).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    // Expected: GNU date, `date -u -d @N +%FT%TZ`.
    #[test]
    fn dates_are_formatted_as_by_gnu_date() {
        for (seconds, expected) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_709_251_199, "2024-02-29T23:59:59Z"),
            (4_102_444_800, "2100-01-01T00:00:00Z"),
        ] {
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
            assert_eq!(rfc3339(time), expected);
        }
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(951_782_399);
        assert_eq!(compact(time), "20000228-235959");
    }
}
