//! Recorded samples as training takes them: averaged, thinned, and beside them the smoothed pairs
//! that a network is judged by.

use super::Recording;
use crate::scenario::Recipe;
use crate::training::{Averaging, Dataset, Smoothing, SmoothingError};

/// Cleaned samples of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Cleaned {
    /// What a network is trained on, in the order of time.
    pub data: Dataset,
    /// Smoothed pairs, in the order of time. The same as `data`, unless the recipe asks for raw
    /// samples that carry chatter: no network is to be judged by that.
    pub judged: Dataset,
    /// Of each row of `judged`, the row of `data` that it belongs to.
    rows: Vec<usize>,
    /// Length of the averaging window in use; 0 for none. \[s\]
    pub window: f64,
    /// Every how many averages one was kept.
    pub stride: usize,
    /// Period of the signal, if it rises above its chatter. \[s\]
    pub period: Option<f64>,
}

impl Cleaned {
    /// Averages and thins `recording` as `recipe` says, or else as the samples' own spectrum does.
    /// What is shorter than the window between two gaps is left out.
    ///
    /// # Errors
    /// If no window fits between any two gaps.
    pub fn new(recording: &Recording, recipe: &Recipe) -> Result<Self, SmoothingError> {
        let pieces: Vec<Dataset> = recording.pieces().collect();
        let interval = recording.interval;
        let averaging = Averaging::of(&pieces, interval);
        let window = recipe.smoothing_window.unwrap_or(averaging.window);
        let stride = match recipe.decimation {
            Some(decimation) => decimation.get() as usize,
            None => Averaging::stride(window, interval),
        };
        let smoothing = Smoothing { window, stride };
        let data = smooth_all(&pieces, |piece| smoothing.apply(piece, interval))?;
        let raw = window == 0.0 && averaging.window > 0.0;
        let judged =
            if raw { judge_raw(&pieces, averaging.window, interval, stride) } else { None };
        let (judged, rows) = judged.unwrap_or_else(|| (data.clone(), (0..data.len()).collect()));
        Ok(Self { data, judged, rows, window, stride, period: averaging.period })
    }

    /// The judged samples that belong to the rows of `data` for which `chosen` is true.
    #[must_use]
    pub fn judged_in(&self, chosen: &[bool]) -> Option<Dataset> {
        let belongs = |&index: &usize| chosen.get(self.rows[index]).copied().unwrap_or(false);
        self.judged.select(&(0..self.rows.len()).filter(belongs).collect::<Vec<_>>())
    }
}

/// All that `smooth` makes of the pieces, or its last refusal if that is nothing.
fn smooth_all(
    pieces: &[Dataset],
    smooth: impl Fn(&Dataset) -> Result<Dataset, SmoothingError>,
) -> Result<Dataset, SmoothingError> {
    let (mut inputs, mut targets, mut refused) = (Vec::new(), Vec::new(), None);
    for piece in pieces {
        match smooth(piece) {
            Ok(data) => {
                inputs.extend_from_slice(data.inputs());
                targets.extend_from_slice(data.targets());
            }
            Err(error) => refused = Some(error),
        }
    }
    match refused {
        Some(error) if inputs.is_empty() => Err(error),
        _ => {
            let dimension = pieces.first().map_or(0, Dataset::dimension);
            Ok(Dataset::new(dimension, inputs, targets)?)
        }
    }
}

/// Smoothed pairs for raw samples of which every `stride`-th is trained on, and the row of each
/// among those; `None` if no window fits.
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
            let n = smooth.dimension();
            let kept = (half..half + smooth.len()).filter(|sample| sample.is_multiple_of(stride));
            for sample in kept {
                let place = (sample - half) * n..(sample - half + 1) * n;
                inputs.extend_from_slice(&smooth.inputs()[place.clone()]);
                targets.extend_from_slice(&smooth.targets()[place]);
                rows.push(first_row + sample / stride);
            }
        }
        first_row += piece.len().div_ceil(stride);
    }
    let dimension = pieces.first()?.dimension();
    Some((Dataset::new(dimension, inputs, targets).ok()?, rows))
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU32;

    use super::*;
    use crate::scenario::{PAPER, Scenario};

    /// A slow wave whose derivative carries chatter, up to half as large.
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
            outer_weights: None,
        }
    }

    fn recipe(window: Option<f64>, decimation: Option<u32>) -> Recipe {
        let mut recipe = Scenario::parse("p", PAPER).unwrap().recipe("better").unwrap().clone();
        recipe.smoothing_window = window;
        recipe.decimation = decimation.and_then(NonZeroU32::new);
        recipe
    }

    #[test]
    fn the_samples_choose_their_window() {
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
        for (gaps, stride) in [(&[][..], 1), (&[1001, 1010], 3)] {
            let recording = recording(gaps);
            let cleaned = Cleaned::new(&recording, &recipe(Some(0.0), Some(stride))).unwrap();
            let pieces: Vec<_> = recording.pieces().collect();
            let kept = pieces.iter().map(|p| p.len().div_ceil(stride as usize)).sum::<usize>();
            assert_eq!(cleaned.data.len(), kept);
            // The chatter of half a unit is gone, and each row is beside its own sample.
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
}
