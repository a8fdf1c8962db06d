//! The harmonic in what a network leaves of a recorded direction:
//!
//! `r(t) = mean of (d/dt xi - (T f_hat)(xi_hat)) = a cos omega t + b sin omega t + c + rest`
//!
//! The frequency is the one that explains most of `r`: the best of a grid, then refined by golden
//! section. Samples are averaged over a window, which shrinks the harmonic by a known factor.
//!
//! Cost: one least-squares fit of three unknowns for each frequency of the grid.

use nalgebra::{Matrix3, Vector3};

use crate::packages::Recording;
use crate::training::Dataset;

/// Least and greatest frequency that is looked for. \[rad/s\]
const RANGE: [f64; 2] = [0.6, 12.0];

/// Step of the grid. \[rad/s\]
const GRID: f64 = 0.05;

/// Steps of golden section.
const REFINEMENTS: usize = 30;

/// Length of the averages. \[s\]
const WINDOW: f64 = 0.4;

/// Averages in a window.
const PER_WINDOW: usize = 20;

/// Least share of the rest that a harmonic must explain.
const EXPLAINED_MIN: f64 = 0.5;

/// Least size of the rest, as a share of the rate's deviation.
const REST_MIN: f64 = 0.02;

/// Half-width of the interval in which a known frequency is looked for again. \[rad/s\]
const AGAIN: f64 = 0.4;

/// A harmonic, `amplitude[0] cos(omega t) + amplitude[1] sin(omega t)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Harmonic {
    /// `omega`. \[rad/s\]
    pub frequency: f64,
    /// Of the rate, not of its averages. \[unit of `xi`/s\]
    pub amplitude: [f64; 2],
    /// Share of the rest that it explains.
    pub explained: f64,
}

impl Harmonic {
    /// Returns its value at `time` \[s\].
    #[must_use]
    pub fn at(&self, time: f64) -> f64 {
        let phase = self.frequency * time;
        self.amplitude[0] * libm::cos(phase) + self.amplitude[1] * libm::sin(phase)
    }

    /// Finds the harmonic in what `model`, `f_hat`, leaves of the direction `row` of `T`, shape `[n]`;
    /// near `known` \[rad/s\] if that is given. `None` if there is none worth mentioning.
    #[must_use]
    pub fn find(
        recording: &Recording,
        row: &[f64],
        model: &dyn Fn(&[f64], &mut [f64]),
        known: Option<f64>,
    ) -> Option<Self> {
        let averages = Averages::new(recording, row, model)?;
        let range = known.map_or(RANGE, |known| [(known - AGAIN).max(0.3), known + AGAIN]);
        let count = ((range[1] - range[0]) / GRID).ceil().max(1.0) as usize;
        let grid = |k: usize| range[0] + k as f64 * GRID;
        let explained = |frequency: f64| averages.fit(frequency).map_or(0.0, |fit| fit.explained);
        let best = (0..=count).map(|k| (k, explained(grid(k))));
        let (best, _) = best.max_by(|a, b| a.1.total_cmp(&b.1))?;
        let (mut low, mut high) = (grid(best.saturating_sub(1)), grid((best + 1).min(count)));
        let golden = (5f64.sqrt() - 1.0) / 2.0;
        for _ in 0..REFINEMENTS {
            let (left, right) = (high - golden * (high - low), low + golden * (high - low));
            if explained(left) > explained(right) { high = right } else { low = left }
        }
        let harmonic = averages.fit(0.5 * (low + high))?;
        eprintln!("DBG {harmonic:?} rest {} rate {}", averages.rest_deviation(), averages.rate_deviation);
        let is_large = averages.rest_deviation() >= REST_MIN * averages.rate_deviation;
        (known.is_some() || (is_large && harmonic.explained >= EXPLAINED_MIN)).then_some(harmonic)
    }

    /// Returns the recording without this harmonic along `column`, the direction's column of `T^-1`.
    #[must_use]
    pub fn taken_from(&self, recording: &Recording, column: &[f64]) -> Option<Recording> {
        let n = recording.samples.dimension();
        let mut targets = recording.samples.targets().to_vec();
        for (rates, tick) in targets.chunks_exact_mut(n).zip(recording.ticks()) {
            let value = self.at(recording.start + tick as f64 * recording.interval);
            for (rate, share) in rates.iter_mut().zip(column) {
                *rate -= share * value;
            }
        }
        let samples = Dataset::new(n, recording.samples.inputs().to_vec(), targets).ok()?;
        Some(Recording { samples, ..recording.clone() })
    }
}

/// Averages of what a model leaves.
struct Averages {
    /// Time and rest of each.
    rests: Vec<(f64, f64)>,
    rate_deviation: f64,
}

impl Averages {
    fn new(recording: &Recording, row: &[f64], model: &dyn Fn(&[f64], &mut [f64])) -> Option<Self> {
        let n = recording.samples.dimension();
        let (inputs, targets) = (recording.samples.inputs(), recording.samples.targets());
        let ticks = recording.ticks();
        let width = ((WINDOW / recording.interval).round() as usize).max(1);
        let stride = (width / PER_WINDOW).max(1);
        let (mut rests, mut rates) = (Vec::new(), Vec::new());
        let mut flow = vec![0.0; n];
        let mut start = 0;
        while start + width <= ticks.len() {
            // A window does not bridge a gap.
            if ticks[start + width - 1] - ticks[start] == width as u64 - 1 {
                let mean = |values: &[f64]| -> Vec<f64> {
                    let rows = values[start * n..(start + width) * n].chunks_exact(n);
                    let mut sum = vec![0.0; n];
                    for row in rows {
                        sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
                    }
                    sum.iter().map(|sum| sum / width as f64).collect()
                };
                model(&mean(inputs), &mut flow);
                let along = |x: &[f64]| row.iter().zip(x).fold(0.0, |sum, (row, x)| sum + row * x);
                let rate = along(&mean(targets));
                let middle = ticks[start] as f64 + 0.5 * (width as f64 - 1.0);
                rests.push((recording.start + middle * recording.interval, rate - along(&flow)));
                rates.push(rate);
            }
            start += stride;
        }
        let rate_deviation = deviation(rates.iter().copied());
        (rests.len() >= 4 * PER_WINDOW).then_some(Self { rests, rate_deviation })
    }

    fn rest_deviation(&self) -> f64 {
        deviation(self.rests.iter().map(|&(_, rest)| rest))
    }

    /// Fits a harmonic of this frequency.
    fn fit(&self, frequency: f64) -> Option<Harmonic> {
        let mut normal = Matrix3::zeros();
        let mut right = Vector3::zeros();
        let basis =
            |time: f64| Vector3::new(libm::cos(frequency * time), libm::sin(frequency * time), 1.0);
        for &(time, rest) in &self.rests {
            let basis = basis(time);
            normal += basis * basis.transpose();
            right += basis * rest;
        }
        let solution = normal.cholesky()?.solve(&right);
        let left = self.rests.iter().fold(0.0, |sum, &(time, rest)| {
            let error = rest - basis(time).dot(&solution);
            sum + error * error
        });
        let size = self.rest_deviation();
        let all = size * size * self.rests.len() as f64;
        let half = 0.5 * frequency * WINDOW;
        let shrunk = libm::sin(half) / half;
        Some(Harmonic {
            frequency,
            amplitude: [solution[0] / shrunk, solution[1] / shrunk],
            explained: 1.0 - left / all.max(f64::MIN_POSITIVE),
        })
    }
}

fn deviation(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().fold(0.0, |sum, x| sum + x) / count;
    (values.fold(0.0, |sum, x| sum + (x - mean) * (x - mean)) / count).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packages::Timing;

    /// A recording at 1 kHz of a rotation at 0.7 rad/s whose second rate has a harmonic, with a gap of 50
    /// samples after the first 1,500.
    fn recording(frequency: f64) -> Recording {
        let times = (0..6_000).filter(|k| !(1_500..1_550).contains(k)).map(|k| 1e-3 * f64::from(k));
        let (mut inputs, mut targets) = (Vec::new(), Vec::new());
        for t in times {
            let state = [libm::sin(0.7 * t), libm::cos(0.7 * t)];
            inputs.extend(state);
            let harmonic = 0.4 * libm::sin(frequency * t + 0.3) + 0.1;
            targets.extend([0.7 * state[1], -0.7 * state[0] + harmonic]);
        }
        Recording {
            samples: Dataset::new(2, inputs, targets).unwrap(),
            gaps: vec![1_500],
            start: 0.0,
            interval: 1e-3,
            timing: Timing { missing: vec![50], ..Timing::default() },
            outer_weights: None,
            observed: None,
        }
    }

    fn exact(x: &[f64], f: &mut [f64]) {
        f.copy_from_slice(&[0.7 * x[1], -0.7 * x[0]]);
    }

    #[test]
    fn a_harmonic_is_found_and_taken_away() {
        for frequency in [2.5, 3.75, 6.2] {
            let recording = recording(frequency);
            let found = Harmonic::find(&recording, &[0.0, 1.0], &exact, None).unwrap();
            assert!((found.frequency - frequency).abs() < 0.1, "{found:?}");
            let size = libm::hypot(found.amplitude[0], found.amplitude[1]);
            assert!((size - 0.4).abs() < 0.06, "{found:?}");
            let rest = found.taken_from(&recording, &[0.0, 1.0]).unwrap();
            let left = Harmonic::find(&rest, &[0.0, 1.0], &exact, Some(frequency)).unwrap();
            assert!(libm::hypot(left.amplitude[0], left.amplitude[1]) < 0.06, "{left:?}");
            // The other component is as before.
            let first = |r: &Recording| -> Vec<f64> {
                r.samples.targets().iter().step_by(2).copied().collect()
            };
            assert_eq!(first(&rest), first(&recording));
        }
    }

    #[test]
    fn nothing_is_found_where_there_is_nothing() {
        let recording = recording(3.0);
        assert_eq!(Harmonic::find(&recording, &[1.0, 0.0], &exact, None), None);
        let short = Recording {
            samples: recording.samples.select(&(0..300).collect::<Vec<_>>()).unwrap(),
            gaps: Vec::new(),
            ..recording
        };
        assert_eq!(Harmonic::find(&short, &[0.0, 1.0], &exact, None), None);
    }
}
