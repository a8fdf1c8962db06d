//! Cleans recorded samples before training: centred moving average and decimation.
//!
//! ```text
//! x̄_j = (1/(2h+1)) Σ_(|d| ≤ h) x_(js+h+d),   h = round(window / (2 step)),   s the stride
//! ```
//!
//! The targets ẋ̂ carry the high-gain chatter of the consensus term; a flexible network fits
//! it. Inputs and targets are averaged alike, so that for a motion that is smooth over the
//! window the pair stays on the graph of f up to second order in the window.
//!
//! Cost: `2h + 1` additions for every value kept.
//!
//! Invariants: only full windows are averaged: h samples are lost at either end, and none is
//! invented. A window shorter than two steps and a stride of 1 change nothing. Samples must be
//! equidistant, in the order of time.

use super::data::{DataError, Dataset};

/// Moving average and decimation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Smoothing {
    /// Length of the averaging window `[s]`; 0 for none.
    pub window: f64,
    /// Every how many samples one is kept, at least 1.
    pub stride: usize,
}

/// Why samples cannot be smoothed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SmoothingError {
    /// The window is negative or not finite.
    #[error("smoothing window {window} s, expected a finite number from 0")]
    Window {
        /// Its length `[s]`.
        window: f64,
    },
    /// The sampling interval is not positive.
    #[error("sampling interval {step} s, expected a finite number above 0")]
    Step {
        /// The interval `[s]`.
        step: f64,
    },
    /// The stride is 0.
    #[error("smoothing stride 0, expected at least 1")]
    Stride,
    /// No full window fits into the samples.
    #[error(transparent)]
    Data(#[from] DataError),
}

impl Smoothing {
    /// Samples as they were recorded.
    pub const NONE: Self = Self { window: 0.0, stride: 1 };

    /// Smooths samples that are `step` `[s]` apart.
    ///
    /// # Errors
    /// If a field or `step` is out of range, or no full window fits.
    pub fn apply(&self, data: &Dataset, step: f64) -> Result<Dataset, SmoothingError> {
        let half = self.half_width(step)?;
        if self.stride == 0 {
            return Err(SmoothingError::Stride);
        }
        let (found, needed) = (data.len(), half.saturating_mul(2).saturating_add(1));
        if found < needed {
            return Err(DataError::TooFewSamples { found, needed }.into());
        }
        let n = data.dimension();
        let average = |values: &[f64]| -> Vec<f64> {
            let mut means = Vec::new();
            for first in (0..=found - needed).step_by(self.stride) {
                let window = &values[first * n..(first + needed) * n];
                for i in 0..n {
                    let sum = window.iter().skip(i).step_by(n).fold(0.0, |sum, x| sum + x);
                    means.push(sum / needed as f64);
                }
            }
            means
        };
        Ok(Dataset::new(n, average(data.inputs()), average(data.targets()))?)
    }

    /// h, samples to either side of a window's centre.
    ///
    /// # Errors
    /// If the window or `step` is out of range.
    #[allow(clippy::cast_possible_truncation, reason = "saturates; longer than any record")]
    pub fn half_width(&self, step: f64) -> Result<usize, SmoothingError> {
        if !(step > 0.0 && step.is_finite()) {
            return Err(SmoothingError::Step { step });
        }
        if !(self.window >= 0.0 && self.window.is_finite()) {
            return Err(SmoothingError::Window { window: self.window });
        }
        Ok((0.5 * self.window / step).round() as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::assert_close;

    const STEP: f64 = 0.001;

    fn ramp(samples: usize) -> Dataset {
        let row = |s: usize| [s as f64, 100.0 - 2.0 * s as f64];
        let inputs = (0..samples).flat_map(row).collect();
        // A square wave of one sample around 7: chatter.
        let targets = (0..samples).flat_map(|s| [if s % 2 == 0 { 5.0 } else { 9.0 }; 2]).collect();
        Dataset::new(2, inputs, targets).expect("valid")
    }

    #[test]
    fn keeps_what_is_linear_and_removes_chatter() {
        let smooth = Smoothing { window: 0.02, stride: 3 }.apply(&ramp(100), STEP).expect("fits");
        // 21 samples a window, 80 windows, every third: 27.
        assert_eq!(smooth.len(), 27);
        for (j, row) in smooth.inputs().chunks_exact(2).enumerate() {
            let s = (3 * j + 10) as f64;
            assert_close(row, &[s, 100.0 - 2.0 * s], 1e-14, 0.0);
        }
        let worst = smooth.targets().iter().map(|y| (y - 7.0).abs()).fold(0.0, f64::max);
        assert!(worst <= 2.0 / 21.0 + 1e-12, "{worst}");
    }

    #[test]
    fn none_changes_nothing() {
        assert_eq!(Smoothing::NONE.apply(&ramp(10), STEP), Ok(ramp(10)));
    }

    #[test]
    fn refuses_what_does_not_fit() {
        let apply = |window, stride, step| Smoothing { window, stride }.apply(&ramp(20), step);
        assert_eq!(apply(-1.0, 1, STEP), Err(SmoothingError::Window { window: -1.0 }));
        assert_eq!(apply(0.0, 0, STEP), Err(SmoothingError::Stride));
        assert_eq!(apply(0.0, 1, 0.0), Err(SmoothingError::Step { step: 0.0 }));
        let error = DataError::TooFewSamples { found: 20, needed: 21 };
        assert_eq!(apply(0.02, 1, STEP), Err(SmoothingError::Data(error)));
        assert!(apply(0.018, 1, STEP).is_ok_and(|smooth| smooth.len() == 2));
        assert!(apply(1e300, 1, STEP).is_err());
    }
}
