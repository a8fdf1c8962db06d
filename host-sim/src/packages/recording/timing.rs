//! When samples were taken: the interval, what is missing, how even it is.

/// From this many intervals on, the time between two samples is a gap: a sample is missing. What
/// is less is jitter of the clock that wrote the times.
const GAP: f64 = 1.5;

/// Jitter, as a share of the interval, that is not reported.
const EVEN: f64 = 0.25;

/// How regular the samples of a recording are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timing {
    /// Samples that are missing in each gap, at least 1; as many entries as there are gaps.
    pub missing: Vec<u64>,
    /// Intervals that differ from the usual one by more than a quarter of it, and are not gaps.
    pub uneven: usize,
    /// Largest difference of an interval from the usual one, gaps left out. \[s\]
    pub jitter: f64,
    /// Lines that repeat the sample before them, and were left out.
    pub repeated: usize,
}

impl Timing {
    /// Samples that are missing in all gaps.
    #[must_use]
    pub fn missing_samples(&self) -> u64 {
        self.missing.iter().fold(0, |sum, &missing| sum.saturating_add(missing))
    }
}

/// The time between two samples \[s\], the samples that a gap precedes, and how regular they are.
///
/// `times` \[s\], at least two, ascending.
pub(super) fn timing(times: &[f64]) -> (f64, Vec<usize>, Timing) {
    let steps: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let after_gap = steps.iter().enumerate().filter(|&(_, &step)| step >= GAP * median);
    let gaps: Vec<usize> = after_gap.map(|(index, _)| index + 1).collect();
    // Without gaps the mean is what rounded times mean.
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
    fn what_is_missing_is_counted() {
        let times = [0.0, 1.0, 2.0, 4.0, 5.0, 9.0, 10.0];
        let (interval, gaps, timing) = timing(&times);
        assert_eq!((interval, gaps), (1.0, vec![3, 5]));
        assert_eq!((timing.missing.clone(), timing.missing_samples()), (vec![1, 3], 4));
        assert_eq!((timing.uneven, timing.jitter), (0, 0.0));
    }

    #[test]
    fn jitter_is_told_apart_from_gaps() {
        let times = [0.0, 1.0, 2.0, 3.25, 4.0, 5.0, 5.5, 6.5, 7.5];
        let (interval, gaps, timing) = timing(&times);
        assert!(gaps.is_empty());
        // 0.75 and 1.25 are within a quarter of 0.9375 or not: 1.25 and 0.5 are beyond it.
        assert_eq!((interval, timing.uneven), (0.9375, 2));
        assert_eq!(timing.jitter, 0.4375);
    }
}
