//! Prepares recorded samples for training: averages and decimates them, and provides the smoothed
//! pairs for judging a network.

use crate::packages::Recording;
use crate::scenario::Recipe;
use crate::training::{Averaging, Dataset, Smoothed, Smoothing, SmoothingError};

/// Cleaned samples of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Cleaned {
    /// Training data, in time order.
    pub data: Dataset,
    /// Smoothed pairs for judging a network, in time order: the same as `data`, unless the recipe
    /// trains on raw samples, whose chatter would distort the judgement.
    pub judged: Dataset,
    /// For each row of `judged`, the corresponding row of `data`.
    rows: Vec<usize>,
    /// Length of the averaging window, 0 for none. \[s\]
    pub window: f64,
    /// Decimation: one in this many averages is kept.
    pub stride: usize,
    /// Period of the signal, if it can be distinguished from chatter. \[s\]
    pub period: Option<f64>,
    /// Samples skipped because of gaps.
    pub cleaning: Cleaning,
}

/// What was skipped in a recording with gaps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cleaning {
    /// Segments between gaps that are too long for a smoothing window to bridge.
    pub pieces: usize,
    /// Segments skipped because they are shorter than a window.
    pub pieces_left_out: usize,
    /// Recorded samples in skipped segments.
    pub samples_left_out: usize,
    /// Windows skipped because too many samples are missing.
    pub windows_left_out: usize,
}

impl Cleaning {
    fn of(smoothed: &Smoothed) -> Self {
        Self {
            pieces: smoothed.pieces,
            pieces_left_out: smoothed.pieces_left_out,
            samples_left_out: smoothed.samples_left_out,
            windows_left_out: smoothed.windows_left_out,
        }
    }
}

/// Longest gap that is interpolated when choosing the window. \[samples\]
const FILLED_MAX: u64 = 8;

impl Cleaned {
    /// Averages and decimates `recording` with the settings of `recipe` or, by default, settings
    /// derived from the samples' spectrum. A window bridges short gaps; a segment between long gaps
    /// that is shorter than the window is skipped.
    ///
    /// # Errors
    /// If no window fits between two gaps.
    pub fn new(recording: &Recording, recipe: &Recipe) -> Result<Self, SmoothingError> {
        let pieces: Vec<Dataset> = recording.pieces().collect();
        let interval = recording.interval;
        let averaging = Averaging::of(&filled(recording), interval);
        let window = recipe.smoothing_window.unwrap_or(averaging.window);
        let stride = match recipe.decimation {
            Some(decimation) => decimation.get() as usize,
            None => Averaging::stride(window, interval),
        };
        let smoothing = Smoothing { window, stride };
        let smoothed =
            smoothing.apply_with_gaps(&recording.samples, &recording.ticks(), interval)?;
        let cleaning = Cleaning::of(&smoothed);
        let data = smoothed.data;
        // A window shorter than a step does not average.
        let raw = smoothing.half_width(interval)? == 0 && averaging.window > 0.0;
        let judged =
            if raw { judge_raw(&pieces, averaging.window, interval, stride) } else { None };
        let (judged, rows) = judged.unwrap_or_else(|| (data.clone(), (0..data.len()).collect()));
        Ok(Self { data, judged, rows, window, stride, period: averaging.period, cleaning })
    }

    /// Returns the judged samples whose row of `data` is `chosen`.
    #[must_use]
    pub fn judged_in(&self, chosen: &[bool]) -> Option<Dataset> {
        let belongs = |&index: &usize| chosen.get(self.rows[index]).copied().unwrap_or(false);
        self.judged.select(&(0..self.rows.len()).filter(belongs).collect::<Vec<_>>())
    }
}

/// Returns the segments between long gaps, with short gaps filled by linear interpolation. Only for
/// choosing a window: without filling, lost samples would leave segments too short for a slow
/// signal.
fn filled(recording: &Recording) -> Vec<Dataset> {
    let samples = &recording.samples;
    let (n, width) = (samples.dimension(), samples.width());
    let (inputs, targets) = (samples.inputs(), samples.targets());
    let ticks = recording.ticks();
    let mut pieces = Vec::new();
    let (mut filled_inputs, mut filled_targets) = (Vec::new(), Vec::new());
    for (index, &tick) in ticks.iter().enumerate() {
        let missing = index.checked_sub(1).map_or(0, |before| tick - ticks[before] - 1);
        if missing > FILLED_MAX {
            pieces.extend(samples.of_shape(filled_inputs, filled_targets));
            (filled_inputs, filled_targets) = (Vec::new(), Vec::new());
        } else {
            for step in 1..=missing {
                let share = step as f64 / (missing + 1) as f64;
                let between = |values: &[f64], n: usize, i: usize| {
                    let (a, b) = (values[(index - 1) * n + i], values[index * n + i]);
                    a + share * (b - a)
                };
                filled_inputs.extend((0..width).map(|i| between(inputs, width, i)));
                filled_targets.extend((0..n).map(|i| between(targets, n, i)));
            }
        }
        filled_inputs.extend_from_slice(&inputs[index * width..(index + 1) * width]);
        filled_targets.extend_from_slice(&targets[index * n..(index + 1) * n]);
    }
    pieces.extend(samples.of_shape(filled_inputs, filled_targets));
    pieces
}

/// Returns smoothed pairs for every `stride`-th raw sample, and the row of each in the training
/// data; `None` if no window fits.
fn judge_raw(
    pieces: &[Dataset],
    window: f64,
    interval: f64,
    stride: usize,
) -> Option<(Dataset, Vec<usize>)> {
    let smoothing = Smoothing { window, stride: 1 };
    let half = smoothing.half_width(interval).ok()?;
    let (mut inputs, mut targets, mut rows) = (Vec::new(), Vec::new(), Vec::new());
    let mut first_row = 0;
    for piece in pieces {
        if let Ok(smooth) = smoothing.apply(piece, interval) {
            let (n, width) = (smooth.dimension(), smooth.width());
            let kept = (half..half + smooth.len()).filter(|sample| sample.is_multiple_of(stride));
            for sample in kept {
                let place = |n: usize| (sample - half) * n..(sample - half + 1) * n;
                inputs.extend_from_slice(&smooth.inputs()[place(width)]);
                targets.extend_from_slice(&smooth.targets()[place(n)]);
                rows.push(first_row + sample / stride);
            }
        }
        first_row += piece.len().div_ceil(stride);
    }
    Some((pieces.first()?.of_shape(inputs, targets).ok()?, rows))
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU32;

    use super::*;
    use crate::packages::Timing;
    use crate::scenario::{PAPER, Scenario};

    /// A slow wave whose derivative has chatter of up to half its amplitude.
    fn recording(gaps: &[usize]) -> Recording {
        let wave = |s: usize| libm::sin(0.01 * s as f64);
        let chatter = |s: usize| f64::from((s as u32).wrapping_mul(0x9e37_79b9)) / 4.3e9 - 0.5;
        let inputs = (0..3000).map(wave).collect();
        let targets = (0..3000).map(|s| libm::cos(0.01 * s as f64) + chatter(s)).collect();
        Recording {
            samples: Dataset::new(1, inputs, targets).unwrap(),
            gaps: gaps.to_vec(),
            start: 0.0,
            interval: 0.01,
            timing: Timing { missing: vec![1; gaps.len()], ..Timing::default() },
            outer_weights: None,
            observed: None,
        }
    }

    fn recipe(window: Option<f64>, decimation: Option<u32>) -> Recipe {
        let mut recipe = Scenario::parse("p", PAPER).unwrap().recipe("better").unwrap().clone();
        recipe.smoothing_window = window;
        recipe.decimation = decimation.and_then(NonZeroU32::new);
        recipe
    }

    #[test]
    fn the_window_is_derived_from_the_samples() {
        let cleaned = Cleaned::new(&recording(&[]), &recipe(None, None)).unwrap();
        assert!(cleaned.window > 0.02 && cleaned.window < 2.0, "{cleaned:?}");
        assert_eq!(cleaned.data, cleaned.judged);
        let period = cleaned.period.unwrap();
        assert!(period > 5.0 && period < 8.0, "{period}");
        let worst = cleaned.data.inputs().iter().zip(cleaned.data.targets());
        let worst = worst.fold(0.0f64, |w, (x, y)| w.max((y * y + x * x - 1.0).abs()));
        assert!(worst < 0.1, "{worst}");
    }

    #[test]
    fn raw_samples_are_judged_without_their_chatter() {
        // A window of half a step does not average, either.
        for (gaps, stride, window) in
            [(&[][..], 1, 0.0), (&[1001, 1010], 3, 0.0), (&[], 1, 0.005 - 1e-9)]
        {
            let recording = recording(gaps);
            let cleaned = Cleaned::new(&recording, &recipe(Some(window), Some(stride))).unwrap();
            let pieces: Vec<_> = recording.pieces().collect();
            let kept = pieces.iter().map(|p| p.len().div_ceil(stride as usize)).sum::<usize>();
            assert_eq!(cleaned.data.len(), kept);
            // The chatter is removed, and each row corresponds to its sample.
            for (index, &row) in cleaned.rows.iter().enumerate() {
                let (x, y) = (cleaned.judged.inputs()[index], cleaned.judged.targets()[index]);
                assert!((x - cleaned.data.inputs()[row]).abs() < 0.05, "{index}");
                assert!((y - cleaned.data.targets()[row]).abs() < 0.6, "{index}");
                assert!((x * x + y * y - 1.0).abs() < 0.1, "{index}");
            }
            let chosen: Vec<bool> = (0..kept).map(|row| row < 500).collect();
            let part = cleaned.judged_in(&chosen).unwrap();
            assert_eq!(part.len(), cleaned.rows.iter().filter(|&&row| row < 500).count());
        }
    }

    #[test]
    fn extremely_long_gaps_are_supported() {
        let mut recording = recording(&[1000, 2000]);
        recording.timing.missing = vec![u64::MAX; 2];
        let cleaned = Cleaned::new(&recording, &recipe(Some(0.0), Some(1))).unwrap();
        assert_eq!(cleaned.data.len(), 3000);
    }

    #[test]
    fn no_window_bridges_two_recordings() {
        let constant = |value: f64| Recording {
            samples: Dataset::new(1, vec![value; 400], vec![-value; 400]).unwrap(),
            ..recording(&[])
        };
        let joined = Recording::joined(&[constant(1.0), constant(5.0)]).unwrap();
        let cleaned = Cleaned::new(&joined, &recipe(Some(0.2), Some(1))).unwrap();
        let is_one = |x: &f64| (x - 1.0).abs() < 1e-9 || (x - 5.0).abs() < 1e-9;
        assert!(cleaned.data.len() > 700 && cleaned.data.inputs().iter().all(is_one));
    }

    #[test]
    fn lost_samples_change_the_window_little() {
        let whole = recording(&[]);
        let window = Cleaned::new(&whole, &recipe(None, None)).unwrap().window;
        let kept: Vec<usize> = (0..3000).filter(|s| s % 7 != 3 && s % 31 != 5).collect();
        let gap = |pair: &[usize]| (pair[1] - pair[0] - 1) as u64;
        let after = (1..kept.len()).filter(|&i| gap(&kept[i - 1..=i]) > 0);
        let gaps: Vec<usize> = after.collect();
        let missing = gaps.iter().map(|&i| gap(&kept[i - 1..=i])).collect();
        let lossy = Recording {
            samples: whole.samples.select(&kept).unwrap(),
            gaps,
            timing: Timing { missing, ..Timing::default() },
            ..whole
        };
        let cleaned = Cleaned::new(&lossy, &recipe(None, None)).unwrap();
        assert!(cleaned.window > 0.5 * window && cleaned.window < 2.0 * window, "{cleaned:?}");
        assert_eq!((cleaned.cleaning.pieces, cleaned.cleaning.samples_left_out), (1, 0));
    }
}
