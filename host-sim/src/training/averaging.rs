//! Chooses the averaging window of recorded samples from the samples themselves.
//!
//! The targets carry fast chatter on top of a slow signal. The Hadamard variance, the mean square
//! of second differences between neighbouring averages over a time T, shows how much of each
//! remains at T:
//!
//! ```text
//! V(T) = (1/6) mean_t (ȳ_T(t + 2T) − 2 ȳ_T(t + T) + ȳ_T(t))²
//! ```
//!
//! V is a spectral measure: V(T) is the power in about an octave around the frequency 0.37/T.
//! Chatter makes it fall with T, and the signal's curvature makes it rise with T⁴; it is smallest
//! where both are equal. There the error that averaging adds to the signal, ÿT²/24, is still √96
//! times smaller than its contribution to V. Since the chatter of a bounded estimate falls with T²,
//! the window with the smallest error is about 96^(1/6) = 2.1 times as long: **the window is twice
//! the averaging time with the smallest V**. If V rises from the first sample on, there is no
//! chatter, and the window is 0.
//!
//! The inputs show which fall of V is due to the signal, because the estimate itself has little
//! chatter: the averaging time at which V of an input is largest belongs to the motion of that
//! component. Only shorter times are considered, because averages over a whole period are small as
//! well.
//!
//! Cost: twelve operations per sample, component and averaging time, with about four averaging
//! times per octave.
//!
//! Invariants: every sum has a fixed order; the result is independent of the units of state and
//! targets.

use super::data::Dataset;
use super::scaling::Spread;

/// A sine of period P has its largest V at an averaging time of 0.37 P.
const PEAK: f64 = 0.37;

/// The result of the analysis.
#[derive(Clone, Debug, PartialEq)]
pub struct Averaging {
    /// Window of the centred moving average that balances chatter and signal; 0 for none. \[s\]
    pub window: f64,
    /// The shortest period of all components; `None` if no component moves. \[s\]
    pub period: Option<f64>,
}

impl Averaging {
    /// Analyses `pieces` of equidistant samples, `interval` \[s\] apart.
    #[must_use]
    pub fn of(pieces: &[Dataset], interval: f64) -> Self {
        let n = pieces.first().map_or(0, Dataset::dimension);
        let longest = pieces.iter().map(Dataset::len).max().unwrap_or(0);
        let lengths = averaging_lengths(longest / 3);
        let components: Vec<Component> =
            (0..n).filter_map(|c| Component::of(pieces, c, &lengths)).collect();
        let power = |index| components.iter().fold(0.0, |sum, part| sum + part.power(index));
        let least = (0..lengths.len())
            .map(|index| (power(index), index))
            .reduce(|least, now| if now.0 < least.0 { now } else { least });
        let window = match least.filter(|_| !components.is_empty()) {
            Some((_, least)) if lengths[least] > 1 => 2.0 * lengths[least] as f64 * interval,
            _ => 0.0,
        };
        let shortest = components.iter().map(|component| lengths[component.peak]).min();
        Self { window, period: shortest.map(|length| length as f64 * interval / PEAK) }
    }

    /// Returns the stride for the averages: about twenty per window, or every sample without a
    /// window.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "small, positive")]
    pub fn stride(window: f64, interval: f64) -> usize {
        ((window / (20.0 * interval)).round() as usize).max(1)
    }
}

/// One component of the samples.
struct Component {
    /// V of the targets for each averaging length.
    variances: Vec<f64>,
    /// Index of the length with the largest V of the inputs, which is that of the component's
    /// motion.
    peak: usize,
}

impl Component {
    /// Returns `None` if the input varies by no more than rounding, or there are too few samples.
    fn of(pieces: &[Dataset], index: usize, lengths: &[usize]) -> Option<Self> {
        let inputs: Vec<f64> = pieces.iter().flat_map(|piece| piece.inputs()).copied().collect();
        let (n, width) = (pieces.first()?.dimension(), pieces.first()?.width());
        Spread::of(&inputs, width, index).varies.then_some(())?;
        let variances = |values: fn(&Dataset) -> &[f64], n: usize| -> Vec<f64> {
            let sums: Vec<Vec<f64>> =
                pieces.iter().map(|piece| running_sums(values(piece), n, index)).collect();
            lengths.iter().map(|&m| hadamard(&sums, m)).collect()
        };
        let of_inputs = variances(Dataset::inputs, width);
        let peaks = of_inputs.iter().enumerate().map(|(index, &variance)| (variance, index));
        let (largest, peak) = peaks.reduce(|best, now| if now.0 > best.0 { now } else { best })?;
        (largest > 0.0).then(|| Self { variances: variances(Dataset::targets, n), peak })
    }

    /// Returns V of the targets at a length, relative to V at the length of the motion; for longer
    /// lengths, at least that.
    fn power(&self, index: usize) -> f64 {
        let motion = self.variances[self.peak];
        if motion > 0.0 { self.variances[index.min(self.peak)] / motion } else { 0.0 }
    }
}

/// Returns 1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20 ... up to `longest`.
fn averaging_lengths(longest: usize) -> Vec<usize> {
    let mut lengths = Vec::new();
    let mut length = 1usize;
    while length <= longest {
        lengths.push(length);
        length += (length.next_power_of_two() / 8).max(1);
    }
    lengths
}

/// Returns the sums of the first 0, 1, 2 ... values of a component, relative to its first value.
fn running_sums(values: &[f64], dimension: usize, index: usize) -> Vec<f64> {
    let first = values.get(index).copied().unwrap_or(0.0);
    let values = values.iter().skip(index).step_by(dimension).map(|value| value - first);
    let mut sums = vec![0.0];
    sums.extend(values.scan(0.0, |sum, y| {
        *sum += y;
        Some(*sum)
    }));
    sums
}

/// Computes V for averages over `m` samples, over all pieces that are long enough.
fn hadamard(pieces: &[Vec<f64>], m: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for sums in pieces {
        for start in 0..sums.len().saturating_sub(3 * m) {
            let [a, b, c, d] = [0, m, 2 * m, 3 * m].map(|offset| sums[start + offset]);
            let difference = ((d - c) - (c - b)) - ((c - b) - (b - a));
            sum += difference * difference;
            count += 1.0;
        }
    }
    sum / (6.0 * count * (m * m) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::random_values;

    const STEP: f64 = 0.001;

    /// Creates a sine of period `period` \[s\] and amplitude 1, with white noise of this amplitude.
    fn noisy_sine(samples: usize, period: f64, noise: f64, unit: f64) -> Dataset {
        let random = random_values(samples, 3);
        let angle = |s: usize| 2.0 * std::f64::consts::PI * s as f64 * STEP / period;
        let targets: Vec<f64> =
            (0..samples).map(|s| unit * (libm::sin(angle(s)) + noise * random[s])).collect();
        let inputs = (0..samples).map(|s| -unit * period * libm::cos(angle(s))).collect();
        Dataset::new(1, inputs, targets).expect("valid")
    }

    /// Returns the mean squared error of the centred average over `window` relative to the sine.
    fn error(data: &Dataset, period: f64, window: f64) -> f64 {
        let half = (0.5 * window / STEP).round() as usize;
        let first = data.targets()[0];
        let sums = running_sums(data.targets(), 1, 0);
        let range = half..data.len() - half;
        let count = range.len() as f64;
        let squares = range.map(|s| {
            let average = first + (sums[s + half + 1] - sums[s - half]) / (2 * half + 1) as f64;
            let truth = libm::sin(2.0 * std::f64::consts::PI * s as f64 * STEP / period);
            (average - truth) * (average - truth)
        });
        squares.sum::<f64>() / count
    }

    #[test]
    fn window_is_close_to_optimal() {
        for (period, noise) in [(2.0, 0.3), (2.0, 3.0), (0.5, 1.0), (6.0, 10.0)] {
            let data = noisy_sine(20_000, period, noise, 1.0);
            let found = Averaging::of(std::slice::from_ref(&data), STEP);
            let best = (1..200).map(|k| error(&data, period, 0.002 * f64::from(k)));
            let best = best.fold(f64::INFINITY, f64::min);
            let reached = error(&data, period, found.window);
            assert!(reached <= 3.0 * best, "{period} {noise}: {found:?}, {reached} {best}");
        }
    }

    #[test]
    fn clean_samples_are_not_averaged() {
        let data = noisy_sine(5_000, 1.0, 0.0, 1.0);
        assert_eq!(Averaging::of(&[data], STEP).window, 0.0);
    }

    #[test]
    fn finds_the_period_of_the_signal() {
        for (period, noise) in [(0.2, 0.0), (0.5, 0.5), (2.0, 0.5), (2.0, 3.0)] {
            let data = noisy_sine(20_000, period, noise, 1.0);
            let found = Averaging::of(&[data], STEP).period.expect("a signal");
            assert!(found > 0.8 * period && found < 1.25 * period, "{period}: {found}");
        }
        let still = Dataset::new(1, vec![0.1; 900], random_values(900, 1)).expect("valid");
        assert_eq!(Averaging::of(&[still], STEP), Averaging { window: 0.0, period: None });
    }

    /// Between two broadcasts the estimate is a ramp: its derivative is smooth there and jumps at
    /// the broadcasts.
    #[test]
    fn ramps_between_broadcasts_are_chatter() {
        for interval in [5usize, 20, 60] {
            let angle = |s: usize| s as f64 * STEP;
            let ramp = |s: usize| 20.0 * ((s % interval) as f64 / interval as f64 - 0.5);
            let inputs = (0..9_000).map(|s| libm::sin(angle(s))).collect();
            let targets = (0..9_000).map(|s| libm::cos(angle(s)) + ramp(s)).collect();
            let data = Dataset::new(1, inputs, targets).expect("valid");
            let found = Averaging::of(&[data], STEP);
            assert!(found.window >= 1.5 * STEP * interval as f64, "{interval}: {found:?}");
            assert!(found.window <= 1.5, "{interval}: {found:?}");
            assert!(found.period.is_some_and(|period| period > 4.0), "{interval}: {found:?}");
        }
    }

    #[test]
    fn result_does_not_depend_on_units_or_pieces() {
        let data = noisy_sine(8_000, 1.0, 1.0, 1.0);
        let whole = Averaging::of(&[data], STEP);
        assert_eq!(Averaging::of(&[noisy_sine(8_000, 1.0, 1.0, 1024.0)], STEP), whole);
        let other = Averaging::of(&[noisy_sine(8_000, 1.0, 1.0, 1.0)], 4.0 * STEP);
        assert_eq!(other.window, 4.0 * whole.window);
        let pieces = [1, 2, 3].map(|_| noisy_sine(3_000, 1.0, 1.0, 1.0));
        let cut = Averaging::of(&pieces, STEP).window;
        assert!(cut > 0.5 * whole.window && cut < 2.0 * whole.window, "{cut} {whole:?}");
        let short = Averaging::of(&[noisy_sine(2, 1.0, 1.0, 1.0)], STEP);
        assert_eq!(short, Averaging { window: 0.0, period: None });
    }
}
