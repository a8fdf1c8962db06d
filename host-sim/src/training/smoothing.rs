//! Smooths recorded samples before training: centred moving average and decimation.
//!
//! ```text
//! x̄_j = (1/(2h+1)) Σ_(|d| ≤ h) x_(js+h+d),   h = round(window / (2 step)),   s the stride
//! ```
//!
//! The targets ẋ̂ carry the high-gain chatter of the consensus term, which a flexible network would
//! fit. Inputs and targets are averaged alike: if the motion is smooth over the window, the
//! averaged pair stays on the graph of f up to second order in the window.
//!
//! Cost: `2h + 1` additions per value kept.
//!
//! Where samples are missing, [`Smoothing::apply_with_gaps`] averages over the others. Inputs and
//! targets are averaged over the same samples, so a missing one shifts both alike and the pair
//! stays on the graph of f to the same order. Averaging only becomes less effective: with half of
//! the samples, √2 times as much chatter remains.
//!
//! Invariants: only full windows inside the samples are averaged, so h samples are lost at either
//! end. A window shorter than two steps with a stride of 1 changes nothing. Samples must be
//! equidistant and in order of time. Without a gap both methods give the same bits.

use super::data::{DataError, Dataset};

/// Moving average and decimation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Smoothing {
    /// Length of the averaging window `[s]`; 0 for none.
    pub window: f64,
    /// One average is kept every this many samples, at least 1.
    pub stride: usize,
}

/// Why samples cannot be smoothed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SmoothingError {
    /// The window is negative or not finite.
    #[error("smoothing window {window} s, expected a finite number >= 0")]
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
    /// No window has enough samples between the gaps.
    #[error(
        "{samples} samples in {pieces} pieces between gaps; no piece has at least half the samples of \
             a window of {needed} (the longest has {longest})"
    )]
    Gaps {
        /// Number of samples.
        samples: usize,
        /// Pieces between gaps that windows do not bridge.
        pieces: usize,
        /// Samples per window.
        needed: usize,
        /// Samples in the longest piece.
        longest: usize,
    },
}

/// Smoothed samples, and counts of what was left out.
#[derive(Clone, Debug, PartialEq)]
pub struct Smoothed {
    /// The averages.
    pub data: Dataset,
    /// Pieces between gaps that windows do not bridge.
    pub pieces: usize,
    /// Pieces left out entirely.
    pub pieces_left_out: usize,
    /// Samples in these pieces.
    pub samples_left_out: usize,
    /// Windows left out in other pieces, because too many samples are missing.
    pub windows_left_out: usize,
    /// Samples per full window.
    pub window: usize,
}

impl Smoothing {
    /// Leaves samples as recorded.
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
        let average = |values: &[f64], n: usize| -> Vec<f64> {
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
        let inputs = average(data.inputs(), data.width());
        Ok(data.of_shape(inputs, average(data.targets(), data.dimension()))?)
    }

    /// Smooths samples with gaps. `ticks`, ascending, are the times of the samples in intervals of
    /// `step` `[s]`; shape `[samples]`.
    ///
    /// A window counts if it has at least half of its samples. A gap of more than a quarter of a
    /// window is not bridged: the samples after it are smoothed separately.
    ///
    /// # Errors
    /// If a field or `step` is out of range, or no window has enough samples.
    ///
    /// # Panics
    /// If there are fewer ticks than samples.
    pub fn apply_with_gaps(
        &self,
        data: &Dataset,
        ticks: &[u64],
        step: f64,
    ) -> Result<Smoothed, SmoothingError> {
        let window = self.half_width(step)?.saturating_mul(2).saturating_add(1);
        if self.stride == 0 {
            return Err(SmoothingError::Stride);
        }
        let bridged = (window / 4) as u64;
        let cuts = (1..data.len()).filter(|&i| ticks[i] - ticks[i - 1] > bridged + 1);
        let ends: Vec<usize> = cuts.chain([data.len()]).collect();
        let (mut inputs, mut targets) = (Vec::new(), Vec::new());
        let (mut start, mut longest) = (0, 0);
        let (mut pieces_left_out, mut samples_left_out, mut windows_left_out) = (0, 0, 0);
        for &end in &ends {
            let rows = start..end;
            longest = longest.max(rows.len());
            let (before, mut sparse) = (inputs.len(), 0);
            if ticks[end - 1] - ticks[start] == (rows.len() - 1) as u64 {
                let piece = data.select(&rows.collect::<Vec<_>>());
                if let Some(smooth) = piece.and_then(|piece| self.apply(&piece, step).ok()) {
                    inputs.extend_from_slice(smooth.inputs());
                    targets.extend_from_slice(smooth.targets());
                }
            } else {
                sparse = self.piece_with_gaps(data, ticks, rows, window, &mut inputs, &mut targets);
            }
            if inputs.len() == before {
                pieces_left_out += 1;
                samples_left_out += end - start;
            } else {
                windows_left_out += sparse;
            }
            start = end;
        }
        let (samples, pieces) = (data.len(), ends.len());
        if inputs.is_empty() && pieces == 1 && ticks[samples - 1] - ticks[0] < samples as u64 {
            return Err(DataError::TooFewSamples { found: samples, needed: window }.into());
        }
        if inputs.is_empty() {
            return Err(SmoothingError::Gaps { samples, pieces, needed: window, longest });
        }
        let data = data.of_shape(inputs, targets)?;
        Ok(Smoothed { data, pieces, pieces_left_out, samples_left_out, windows_left_out, window })
    }

    /// Averages over the windows of one piece, the samples `rows`; returns the number of windows
    /// with too few samples.
    fn piece_with_gaps(
        &self,
        data: &Dataset,
        ticks: &[u64],
        rows: std::ops::Range<usize>,
        window: usize,
        inputs: &mut Vec<f64>,
        targets: &mut Vec<f64>,
    ) -> usize {
        let mut mean = |first: usize, end: usize| {
            for (values, means, n) in [
                (data.inputs(), &mut *inputs, data.width()),
                (data.targets(), &mut *targets, data.dimension()),
            ] {
                let values = &values[first * n..end * n];
                for i in 0..n {
                    let sum = values.iter().skip(i).step_by(n).fold(0.0, |sum, x| sum + x);
                    means.push(sum / (end - first) as f64);
                }
            }
        };
        let (start_tick, last_tick) = (ticks[rows.start], ticks[rows.end - 1]);
        let (mut first, mut end, mut left_out) = (rows.start, rows.start, 0);
        let mut tick = start_tick;
        while last_tick - tick >= (window - 1) as u64 {
            while ticks[first] < tick {
                first += 1;
            }
            // A stride longer than the window skips samples between two windows.
            end = end.max(first);
            while end < rows.end && ticks[end] - tick < window as u64 {
                end += 1;
            }
            if 2 * (end - first) >= window {
                mean(first, end);
            } else {
                left_out += 1;
            }
            match tick.checked_add(self.stride as u64).filter(|&next| next <= last_tick) {
                Some(next) => tick = next,
                None => break,
            }
        }
        left_out
    }

    /// Returns h, the number of samples on either side of a window's centre.
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
        // A square wave of one sample around 7, as chatter.
        let targets = (0..samples).flat_map(|s| [if s % 2 == 0 { 5.0 } else { 9.0 }; 2]).collect();
        Dataset::new(2, inputs, targets).expect("valid")
    }

    #[test]
    fn keeps_linear_motion_and_removes_chatter() {
        let smooth = Smoothing { window: 0.02, stride: 3 }.apply(&ramp(100), STEP).expect("fits");
        // 21 samples per window and 80 windows; every third makes 27.
        assert_eq!(smooth.len(), 27);
        for (j, row) in smooth.inputs().chunks_exact(2).enumerate() {
            let s = (3 * j + 10) as f64;
            assert_close(row, &[s, 100.0 - 2.0 * s], 1e-14, 0.0);
        }
        let worst = smooth.targets().iter().map(|y| (y - 7.0).abs()).fold(0.0, f64::max);
        assert!(worst <= 2.0 / 21.0 + 1e-12, "{worst}");
    }

    #[test]
    fn none_keeps_samples_unchanged() {
        assert_eq!(Smoothing::NONE.apply(&ramp(10), STEP), Ok(ramp(10)));
    }

    #[test]
    fn rejects_invalid_settings() {
        let apply = |window, stride, step| Smoothing { window, stride }.apply(&ramp(20), step);
        assert_eq!(apply(-1.0, 1, STEP), Err(SmoothingError::Window { window: -1.0 }));
        assert_eq!(apply(0.0, 0, STEP), Err(SmoothingError::Stride));
        assert_eq!(apply(0.0, 1, 0.0), Err(SmoothingError::Step { step: 0.0 }));
        let error = DataError::TooFewSamples { found: 20, needed: 21 };
        assert_eq!(apply(0.02, 1, STEP), Err(SmoothingError::Data(error)));
        assert!(apply(0.018, 1, STEP).is_ok_and(|smooth| smooth.len() == 2));
        assert!(apply(1e300, 1, STEP).is_err());
    }

    /// Returns every sample of `data` except those at `lost`, and their ticks.
    fn without(data: &Dataset, lost: impl Fn(usize) -> bool) -> (Dataset, Vec<u64>) {
        let kept: Vec<usize> = (0..data.len()).filter(|&index| !lost(index)).collect();
        let ticks = kept.iter().map(|&index| index as u64).collect();
        (data.select(&kept).expect("some are kept"), ticks)
    }

    #[test]
    fn both_methods_agree_bit_for_bit_without_gaps() {
        let data = ramp(100);
        for (window, stride) in [(0.0, 1), (0.0, 7), (0.02, 1), (0.02, 3), (0.098, 2)] {
            let smoothing = Smoothing { window, stride };
            let (all, ticks) = without(&data, |_| false);
            let smoothed = smoothing.apply_with_gaps(&all, &ticks, STEP).expect("fits");
            assert_eq!(Ok(smoothed.data), smoothing.apply(&data, STEP));
            assert_eq!((smoothed.pieces, smoothed.samples_left_out), (1, 0));
        }
        let (all, ticks) = without(&data, |_| false);
        let long = Smoothing { window: 0.2, stride: 1 }.apply_with_gaps(&all, &ticks, STEP);
        assert_eq!(long, Err(DataError::TooFewSamples { found: 100, needed: 201 }.into()));
    }

    #[test]
    fn windows_bridge_missing_samples() {
        let smoothing = Smoothing { window: 0.02, stride: 3 };
        let (data, ticks) = without(&ramp(100), |index| index == 30 || index == 31 || index == 70);
        let smoothed = smoothing.apply_with_gaps(&data, &ticks, STEP).expect("fits");
        // The same number of windows as with every sample, each on the line x_2 = 100 - 2 x_1.
        assert_eq!((smoothed.data.len(), smoothed.pieces, smoothed.window), (27, 1, 21));
        assert_eq!((smoothed.samples_left_out, smoothed.windows_left_out), (0, 0));
        for row in smoothed.data.inputs().chunks_exact(2) {
            assert_close(&[row[1]], &[100.0 - 2.0 * row[0]], 1e-13, 1e-12);
        }
        // The first windows, 0 to 20 and so on, are complete and have the same bits.
        let whole = smoothing.apply(&ramp(100), STEP).expect("fits");
        assert_eq!(smoothed.data.inputs()[..4 * 2], whole.inputs()[..4 * 2]);
        // In the window from 12 to 32, samples 30 and 31 are missing.
        let mean = ((12..=32).sum::<i32>() - 30 - 31) as f64 / 19.0;
        assert_close(&[smoothed.data.inputs()[4 * 2]], &[mean], 1e-14, 0.0);
    }

    #[test]
    fn stride_longer_than_the_window_skips_gaps() {
        let smoothing = Smoothing { window: 0.02, stride: 50 };
        let (data, ticks) = without(&ramp(100), |index| index == 10 || index == 40);
        let smoothed = smoothing.apply_with_gaps(&data, &ticks, STEP).expect("fits");
        // The windows are 0 to 20 without 10, whose mean is still 10, and 50 to 70.
        assert_close(smoothed.data.inputs(), &[10.0, 80.0, 60.0, -20.0], 1e-14, 0.0);
        assert_eq!((smoothed.pieces, smoothed.windows_left_out), (1, 0));
    }

    #[test]
    fn windows_of_omitted_pieces_are_not_counted() {
        let smoothing = Smoothing { window: 0.02, stride: 1 };
        // 40 samples, a gap of 10, then every third of 40 samples: there no window is half full.
        let lost = |index| (40..50).contains(&index) || index >= 50 && index % 3 != 2;
        let (data, ticks) = without(&ramp(90), lost);
        let smoothed = smoothing.apply_with_gaps(&data, &ticks, STEP).expect("fits");
        assert_eq!((smoothed.data.len(), smoothed.pieces), (20, 2));
        assert_eq!((smoothed.pieces_left_out, smoothed.samples_left_out), (1, 14));
        assert_eq!(smoothed.windows_left_out, 0);
    }

    #[test]
    fn long_gaps_split_pieces_and_omissions_are_counted() {
        let smoothing = Smoothing { window: 0.02, stride: 1 };
        // Pieces of 40 samples, of 10, which is too short, and of 38.
        let (data, ticks) =
            without(&ramp(100), |index| (40..46).contains(&index) || (56..62).contains(&index));
        let smoothed = smoothing.apply_with_gaps(&data, &ticks, STEP).expect("fits");
        assert_eq!(
            (smoothed.pieces, smoothed.pieces_left_out, smoothed.samples_left_out),
            (3, 1, 10)
        );
        assert_eq!(smoothed.data.len(), (40 - 20) + (38 - 20));
        // Every second sample: 11 or 10 of 21. Windows that begin with a missing sample have 10.
        let (data, ticks) = without(&ramp(100), |index| index % 2 == 1);
        let half = smoothing.apply_with_gaps(&data, &ticks, STEP).expect("fits");
        assert_eq!((half.data.len(), half.windows_left_out), (40, 39));
    }

    #[test]
    fn only_short_pieces_is_an_error() {
        let smoothing = Smoothing { window: 0.02, stride: 1 };
        let (data, ticks) = without(&ramp(100), |index| index % 20 >= 14);
        let error = smoothing.apply_with_gaps(&data, &ticks, STEP).unwrap_err();
        let expected = SmoothingError::Gaps { samples: 70, pieces: 5, needed: 21, longest: 14 };
        assert_eq!(error, expected);
    }
}
