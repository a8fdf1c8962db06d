//! Numbers with as many digits as a plot can show.

use serde::{Serialize, Serializer};

/// Digits of errors.
pub(super) const DIGITS: usize = 5;

/// A number that is written with this many digits; `null` if it is not finite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Short(pub(super) f64, pub(super) usize);

impl Serialize for Short {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if !self.0.is_finite() {
            return serializer.serialize_none();
        }
        let rounded: f64 = format!("{:.*e}", self.1 - 1, self.0).parse().unwrap_or(self.0);
        // Whole numbers without ".0".
        if rounded.fract() == 0.0 && rounded.abs() < 1e9 {
            return serializer.serialize_i64(rounded as i64);
        }
        serializer.serialize_f64(rounded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_five_digits() {
        let text = |value: f64| serde_json::to_string(&Short(value, DIGITS)).unwrap();
        let cases = [
            (0.123_456_789, "0.12346"),
            (-1.0e-7 / 3.0, "-3.3333e-8"),
            (40.0, "40"),
            (123_456.7, "123460"),
            (0.0, "0"),
            (f64::NAN, "null"),
            (f64::INFINITY, "null"),
        ];
        for (value, expected) in cases {
            assert_eq!(text(value), expected);
        }
    }
}
