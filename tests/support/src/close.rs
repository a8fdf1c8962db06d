//! Comparison of floating-point numbers in tests.

/// Returns whether `found` is within `atol + rtol |expected|` of `expected`.
///
/// Equal infinities are close; NaN is not close to anything.
#[must_use]
pub fn close(found: f64, expected: f64, rtol: f64, atol: f64) -> bool {
    found == expected || (found - expected).abs() <= atol + rtol * expected.abs()
}

#[cfg(test)]
mod tests {
    use super::close;

    #[test]
    fn tolerances_add_up_and_scale_with_what_is_expected() {
        assert!(close(1.5, 1.0, 0.25, 0.25));
        assert!(!close(1.75, 1.0, 0.25, 0.25));
        assert!(close(5.0, 4.0, 0.25, 0.0));
        assert!(!close(4.0, 5.5, 0.25, 0.0));
    }

    #[test]
    fn infinity_and_nan_are_not_close_by_accident() {
        assert!(close(f64::INFINITY, f64::INFINITY, 0.0, 0.0));
        assert!(!close(f64::INFINITY, 1.0, 1.0, 1.0));
        assert!(!close(f64::NAN, f64::NAN, 1.0, 1.0));
        assert!(!close(1.0, f64::NAN, 1.0, 1.0));
    }
}
