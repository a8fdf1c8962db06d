//! Timing of samples: interval, gaps and jitter.

/// Time between two samples, in intervals, above which it is a gap. Smaller deviations are jitter
/// of the recording clock.
const GAP: f64 = 1.5;

/// Largest jitter that is not reported, as a share of the interval.
const EVEN: f64 = 0.25;

/// How regular the samples of a recording are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timing {
    /// Number of missing samples in each gap, at least 1; one entry per gap.
    pub missing: Vec<u64>,
    /// Number of intervals, other than gaps, that deviate by more than a quarter.
    pub uneven: usize,
    /// Largest deviation of an interval, excluding gaps. \[s\]
    pub jitter: f64,
    /// Number of skipped lines that repeat the previous sample.
    pub repeated: usize,
}

impl Timing {
    /// Returns the number of missing samples in all gaps.
    #[must_use]
    pub fn missing_samples(&self) -> u64 {
        self.missing.iter().fold(0, |sum, &missing| sum.saturating_add(missing))
    }
}

/// Returns the interval \[s\], the indices of samples that follow a gap, and the regularity.
///
/// `times` \[s\], at least two, ascending.
pub(super) fn timing(times: &[f64]) -> (f64, Vec<usize>, Timing) {
    let steps: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let after_gap = steps.iter().enumerate().filter(|&(_, &step)| step >= GAP * median);
    let gaps: Vec<usize> = after_gap.map(|(index, _)| index + 1).collect();
    // The mean, excluding gaps, averages out the rounding of times.
    let regular: Vec<f64> = steps.iter().copied().filter(|&step| step < GAP * median).collect();
    let sum = regular.iter().fold(0.0, |sum, step| sum + step);
    let interval = sum / regular.len() as f64;
    let missing = gaps.iter().map(|&gap| {
        let intervals = (steps[gap - 1] / interval).round();
        // Saturates.
        (intervals as u64).saturating_sub(1).max(1)
    });
    let off = |step: &f64| (step - interval).abs();
    let timing = Timing {
        missing: missing.collect(),
        uneven: regular.iter().filter(|step| off(step) > EVEN * interval).count(),
        jitter: regular.iter().map(off).fold(0.0, f64::max),
        repeated: 0,
    };
    (interval, gaps, timing)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_samples_are_counted() {
        let times = [0.0, 1.0, 2.0, 4.0, 5.0, 9.0, 10.0];
        let (interval, gaps, timing) = timing(&times);
        assert_eq!((interval, gaps), (1.0, vec![3, 5]));
        assert_eq!((timing.missing.clone(), timing.missing_samples()), (vec![1, 3], 4));
        assert_eq!((timing.uneven, timing.jitter), (0, 0.0));
    }

    #[test]
    fn jitter_is_distinguished_from_gaps() {
        let times = [0.0, 1.0, 2.0, 3.25, 4.0, 5.0, 5.5, 6.5, 7.5];
        let (interval, gaps, timing) = timing(&times);
        assert!(gaps.is_empty());
        // 0.75 and 1.25 are within a quarter of 0.9375 or not: 1.25 and 0.5 are beyond it.
        assert_eq!((interval, timing.uneven), (0.9375, 2));
        assert_eq!(timing.jitter, 0.4375);
    }
}
