//! Linear axes: round ticks, and labels with no more decimals than needed.
//!
//! Very large and very small values are written as multiples of a power of ten, and values that
//! differ little as offsets from a round number. Power and offset are written once next to the
//! axis, as its [`Axis::note`].

use super::font;

/// An axis from `from` to `to`, both in the unit of the data.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Axis {
    /// Left or lower end.
    pub from: f64,
    /// Right or upper end; greater than `from`.
    pub to: f64,
    /// Distance between labelled ticks.
    step: f64,
    /// Number of minor grid intervals per step.
    parts: u32,
    /// Whether values are exponents of ten.
    powers: bool,
}

impl Axis {
    /// Creates an axis over exactly this range, with about `count` labelled ticks. An empty or
    /// non-finite range is widened to one that can be drawn.
    pub(super) fn exact(from: f64, to: f64, count: f64) -> Self {
        let (from, to) = drawable(from, to);
        let (step, parts) = round_step((to - from) / count.max(1.0));
        Self { from, to, step, parts, powers: false }
    }

    /// Creates a logarithmic axis to base 10, from the power of ten at or below `from` to the one
    /// at or above `to`, both above 0.
    pub(super) fn powers(from: f64, to: f64) -> Self {
        let exponent =
            |value: f64| if value > 0.0 { value.log10().clamp(-300.0, 300.0) } else { 0.0 };
        let from = exponent(from).floor();
        let to = exponent(to).ceil().max(from + 1.0);
        let step = ((to - from) / 4.0).ceil();
        Self { from, to, step, parts: 1, powers: true }
    }

    /// Creates a horizontal axis over exactly this range, `width` long, with as many labels of font
    /// size `size` as fit side by side, at most twelve.
    pub(super) fn horizontal(from: f64, to: f64, width: f64, size: f64) -> Self {
        let mut axis = Self::exact(from, to, 12.0);
        for count in (1..12).rev() {
            let ticks = axis.ticks();
            let widest =
                ticks.iter().map(|&tick| font::width(&axis.label(tick), size)).fold(0.0, f64::max);
            let distance = axis.step / (axis.to - axis.from) * width;
            if widest + 0.9 * size <= distance {
                break;
            }
            axis = Self::exact(from, to, f64::from(count));
        }
        axis
    }

    /// Creates an axis over this range, extended to the next labelled ticks.
    pub(super) fn rounded(from: f64, to: f64, count: f64) -> Self {
        let mut axis = Self::exact(from, to, count);
        // Do not add a step for a thousandth of one.
        axis.from = ((axis.from / axis.step + 1e-3).floor()) * axis.step;
        axis.to = ((axis.to / axis.step - 1e-3).ceil()) * axis.step;
        axis
    }

    /// Returns the positions of the labelled ticks.
    pub(super) fn ticks(&self) -> Vec<f64> {
        self.multiples(self.step)
    }

    /// Returns the positions of the minor grid, including the labelled ticks.
    pub(super) fn minor_ticks(&self) -> Vec<f64> {
        self.multiples(self.step / f64::from(self.parts))
    }

    fn multiples(&self, step: f64) -> Vec<f64> {
        let tolerance = 1e-6;
        let first = (self.from / step - tolerance).ceil();
        let last = (self.to / step + tolerance).floor();
        let count = (last - first).clamp(-1.0, 1e4) as i64 + 1;
        (0..count).map(|index| (first + index as f64) * step).collect()
    }

    /// Formats a tick: without the offset, as a multiple of the power of ten.
    pub(super) fn label(&self, tick: f64) -> String {
        if self.powers {
            return format!("10{}", raised(tick as i32));
        }
        let scale = 10.0_f64.powi(self.exponent());
        decimal((tick - self.offset()) / scale, self.step / scale)
    }

    /// Returns how labels relate to values, such as "×10⁻⁵ + 293"; empty for most axes.
    pub(super) fn note(&self) -> String {
        let (offset, exponent) = (self.offset(), self.exponent());
        let scale = if exponent == 0 { String::new() } else { format!("×10{}", raised(exponent)) };
        // The offset is a multiple of ten steps and needs no more decimals than that.
        let offset = match offset {
            0.0 => String::new(),
            _ if offset < 0.0 => format!("− {}", shortest(decimal(-offset, 10.0 * self.step))),
            _ => format!("+ {}", shortest(decimal(offset, 10.0 * self.step))),
        };
        if scale.is_empty() || offset.is_empty() { scale + &offset } else { scale + " " + &offset }
    }

    /// Returns the offset of the labels: a multiple of ten steps, or 0 if an offset would not
    /// shorten them.
    fn offset(&self) -> f64 {
        let largest = self.from.abs().max(self.to.abs());
        if self.powers || self.to - self.from >= LITTLE * largest || self.from * self.to <= 0.0 {
            return 0.0;
        }
        let unit = 10.0 * self.step;
        (self.from / unit + 1e-6).floor() * unit
    }

    /// Returns the exponent of the power of ten that labels are multiples of.
    fn exponent(&self) -> i32 {
        let offset = self.offset();
        let largest = (self.from - offset).abs().max((self.to - offset).abs());
        if self.powers || (PLAIN_FROM..PLAIN_TO).contains(&largest) || largest == 0.0 {
            return 0;
        }
        (largest.log10() + 1e-9).floor() as i32
    }

    /// Returns the position of `value` between `from` and `to`, as a fraction.
    #[inline]
    pub(super) fn part(&self, value: f64) -> f64 {
        (value - self.from) / (self.to - self.from)
    }
}

/// Labels are written in full from this value \[-\] ...
const PLAIN_FROM: f64 = 1e-2;
/// ... up to below this value.
const PLAIN_TO: f64 = 1e5;

/// An axis shorter than this fraction of its values has an offset.
const LITTLE: f64 = 1e-3;

/// Formats a number with the decimals that multiples of `step` need.
fn decimal(value: f64, step: f64) -> String {
    let decimals = (-(step.log10() + 1e-9).floor()).clamp(0.0, 12.0) as usize;
    let text = format!("{value:.decimals$}");
    // Rounding can produce "-0.0". Negative numbers get a minus sign, not a hyphen.
    let negative = text.starts_with('-') && text.bytes().any(|byte| (b'1'..=b'9').contains(&byte));
    let digits = text.trim_start_matches('-');
    if negative { format!("−{digits}") } else { digits.to_owned() }
}

/// Removes trailing zeros from the decimals of a number.
fn shortest(number: String) -> String {
    if !number.contains('.') {
        return number;
    }
    number.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Formats a number in superscript.
pub(super) fn raised(number: i32) -> String {
    const DIGITS: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let raise = |digit: char| digit.to_digit(10).map_or('⁻', |digit| DIGITS[digit as usize]);
    number.to_string().chars().map(raise).collect()
}

fn drawable(from: f64, to: f64) -> (f64, f64) {
    let from = if from.is_finite() { from } else { 0.0 };
    // Below this, ticks are indistinguishable in double precision.
    let least = from.abs().max(f64::MIN_POSITIVE * 1e30) * 1e-12;
    if to.is_finite() && to - from > least {
        (from, to)
    } else {
        (from, from + from.abs().max(1.0))
    }
}

/// Returns the step of 1, 2 or 5 times a power of ten that is nearest to `step` in proportion, and
/// the number of minor intervals for it.
fn round_step(step: f64) -> (f64, u32) {
    let power = 10.0_f64.powf(step.log10().floor());
    match step / power {
        lead if lead < 1.5 => (power, 5),
        lead if lead < 3.5 => (2.0 * power, 4),
        lead if lead < 7.5 => (5.0 * power, 5),
        _ => (10.0 * power, 5),
    }
}

/// Returns the smallest round number not below `value`, for an axis end that two figures share.
pub(super) fn round_up(value: f64) -> f64 {
    if !(value.is_finite() && value > 0.0) {
        return 1.0;
    }
    let power = 10.0_f64.powf(value.log10().floor());
    let leads = [1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0];
    let lead = leads.into_iter().find(|lead| lead * power >= value * (1.0 - 1e-9));
    lead.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<String> {
        axis.ticks().into_iter().map(|tick| axis.label(tick)).collect()
    }

    #[test]
    fn ticks_are_round_and_labels_are_short() {
        assert_eq!(
            labels(&Axis::exact(0.0, 40.0, 8.0)),
            ["0", "5", "10", "15", "20", "25", "30", "35", "40"]
        );
        assert_eq!(
            labels(&Axis::exact(19.75, 20.25, 5.0)),
            ["19.8", "19.9", "20.0", "20.1", "20.2"]
        );
        assert_eq!(labels(&Axis::exact(-1.0, 1.0, 4.0)), ["−1.0", "−0.5", "0.0", "0.5", "1.0"]);
    }

    #[test]
    fn note_holds_the_common_part_of_the_labels() {
        let of = |from, to, count| {
            let axis = Axis::exact(from, to, count);
            (labels(&axis), axis.note())
        };
        let expect = |labels: &[&str], note: &str| {
            (labels.iter().map(|&label| label.to_owned()).collect::<Vec<_>>(), note.to_owned())
        };
        assert_eq!(of(0.0, 2e-5, 2.0), expect(&["0", "1", "2"], "×10⁻⁵"));
        assert_eq!(of(-1e-4, 1e-4, 4.0), expect(&["−1.0", "−0.5", "0.0", "0.5", "1.0"], "×10⁻⁴"));
        assert_eq!(of(0.0, 3e7, 3.0), expect(&["0", "1", "2", "3"], "×10⁷"));
        assert_eq!(of(0.0, 5.0, 5.0).1, "");
        assert_eq!(of(299.5, 300.5, 2.0), expect(&["299.5", "300.0", "300.5"], ""));
        assert_eq!(of(293.1, 293.3, 2.0), expect(&["0.1", "0.2", "0.3"], "+ 293"));
        assert_eq!(of(-1e5, -99_998.0, 2.0), expect(&["0", "1", "2"], "− 100000"));
        assert_eq!(of(300.0, 300.000_2, 2.0), expect(&["0", "1", "2"], "×10⁻⁴ + 300"));
        assert_eq!(of(86_400.0, 86_400.5, 5.0).1, "+ 86400");
    }

    #[test]
    fn log_axis_ends_on_powers_of_ten() {
        assert_eq!(labels(&Axis::powers(0.03, 12.0)), ["10⁻²", "10⁻¹", "10⁰", "10¹", "10²"]);
        assert_eq!(labels(&Axis::powers(1.0, 1.0)), ["10⁰", "10¹"]);
        assert_eq!(labels(&Axis::powers(1e-9, 1e3)), ["10⁻⁹", "10⁻⁶", "10⁻³", "10⁰", "10³"]);
        assert_eq!(Axis::powers(1e-9, 1e-7).note(), "");
    }

    #[test]
    fn rounded_axis_contains_its_data_and_ends_on_ticks() {
        let axis = Axis::rounded(-3.2, 7.1, 4.0);
        assert!(axis.from <= -3.2 && axis.to >= 7.1);
        let ticks = axis.ticks();
        assert_eq!((ticks[0], *ticks.last().unwrap()), (axis.from, axis.to));
    }

    #[test]
    fn empty_and_non_finite_ranges_are_widened() {
        for (from, to) in
            [(1.0, 1.0), (0.0, f64::NAN), (f64::INFINITY, 2.0), (3.0, 2.0), (1e9, 1e9), (0.0, 0.0)]
        {
            let axis = Axis::exact(from, to, 5.0);
            assert!(axis.to > axis.from && axis.to.is_finite(), "{from} to {to}: {axis:?}");
            assert!(!axis.ticks().is_empty(), "{from} to {to}");
        }
    }

    #[test]
    fn round_up_is_at_least_the_value_and_close_to_it() {
        for value in [0.013, 0.99, 1.0, 1.01, 7.9, 8.1, 123.0] {
            let up = round_up(value);
            assert!(up >= value * (1.0 - 1e-9) && up <= 1.35 * value, "{value} to {up}");
        }
    }
}
