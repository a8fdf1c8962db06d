//! Formats numbers with a fixed number of significant digits, and counts with their noun.

/// Formats `value` with `digits` significant digits: plain from 1e-4 to below 1e6, otherwise
/// scientific.
///
/// # Panics
/// If `digits` is 0.
#[must_use]
pub fn significant(value: f64, digits: usize) -> String {
    assert!(digits > 0, "a number has at least one digit");
    if !value.is_finite() || value == 0.0 {
        return format!("{value}");
    }
    let scientific = format!("{value:.*e}", digits - 1);
    // Exponent of the rounded number: 0.9999 with three digits is 1.00.
    let exponent = scientific.split_once('e').and_then(|(_, exponent)| exponent.parse().ok());
    match exponent.unwrap_or(0) {
        exponent @ -4..6 => {
            let decimals = usize::try_from(digits as i32 - 1 - exponent).unwrap_or(0);
            let rounded = scientific.parse().unwrap_or(value);
            format!("{rounded:.decimals$}")
        }
        _ => scientific,
    }
}

/// Formats a time without the rounding errors of a multiple of a step. \[s\]
#[must_use]
pub fn seconds(time: f64) -> String {
    let digits = 12;
    let short: f64 = format!("{time:.*e}", digits - 1).parse().unwrap_or(time);
    short.to_string()
}

/// `1 entry`, `2 entries`.
#[must_use]
pub fn counted(count: u64, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

#[cfg(test)]
mod tests {
    use super::{seconds, significant};

    #[test]
    fn times_have_no_rounding_errors() {
        assert_eq!([0.205, 1e-3 * 205.0, 40.0, 0.0].map(seconds), ["0.205", "0.205", "40", "0"]);
    }

    #[test]
    fn keeps_digits_at_any_size() {
        let cases = [
            (0.0, "0"),
            (8.2345, "8.23"),
            (0.000_123_45, "0.000123"),
            (0.000_012_345, "1.23e-5"),
            (0.9999, "1.00"),
            (-33.1, "-33.1"),
            (123_456.0, "123000"),
            (999_999.0, "1.00e6"),
            (1.5e300, "1.50e300"),
            (f64::NAN, "NaN"),
            (f64::INFINITY, "inf"),
        ];
        for (value, expected) in cases {
            assert_eq!(significant(value, 3), expected);
        }
        assert_eq!(significant(311_810.148, 9), "311810.148");
        assert_eq!(significant(4.0, 1), "4");
    }
}
