//! The harmonic in the recorded rate of a direction:
//!
//! `mean of d/dt xi = g(x_hat) + a cos omega t + b sin omega t + rest`
//!
//! with a polynomial `g` of the state. Polynomial and harmonic are fitted together: a network that is
//! trained first learns the disturbance along the recorded path as if it were a function of the state,
//! and leaves nothing to find; so does a polynomial of degree 3. The frequency is the one that leaves
//! least: the best of a grid, then refined by golden section. It counts if polynomials of degree 1 and
//! 2 agree on it: what is an oscillation of the plant to one is a function of the state to the other.
//! Samples are averaged over a window, which shrinks the harmonic by a known factor.
//!
//! Cost: two least-squares fits for each of some 260 frequencies.

use nalgebra::{DMatrix, DVector};

use crate::packages::Recording;

/// Lowest and highest frequencies to look for. \[rad/s\]
const RANGE: [f64; 2] = [0.6, 12.0];

/// Step of the grid. \[rad/s\]
const GRID: f64 = 0.05;

/// Steps of golden section.
const REFINEMENTS: usize = 30;

/// Length of the averages. \[s\]
const WINDOW: f64 = 0.4;

/// Averages in a window.
const PER_WINDOW: usize = 20;

/// Least share of what the smooth functions leave that a harmonic must explain.
const EXPLAINED_MIN: f64 = 0.5;

/// Least size of a harmonic, as a share of the rate's deviation.
const SIZE_MIN: f64 = 0.02;

/// Largest difference between the frequencies found with polynomials of degree 1 and 2. \[rad/s\]
const AGREEMENT: f64 = 0.2;

/// Averages for each smooth function, at least.
const SAMPLES_PER_FUNCTION: usize = 8;

/// Share of the squares of a function that its coefficient costs.
const RIDGE: f64 = 1e-8;

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

    /// Finds the harmonic in the rate along the direction `row` of `T`, shape `[n]`; `None` if there is
    /// none worth mentioning, or there are too few samples.
    #[must_use]
    pub fn find(recording: &Recording, row: &[f64]) -> Option<Self> {
        let [first, second] = [1, 2].map(|degree| {
            let averages = Averages::new(recording, row, degree)?;
            let frequency = averages.best_frequency()?;
            Some((averages, frequency))
        });
        let ((_, of_first), (averages, of_second)) = (first?, second?);
        if (of_first - of_second).abs() > AGREEMENT {
            return None;
        }
        averages.harmonic(0.5 * (of_first + of_second))
    }

    /// Fits the harmonic of a frequency that is known \[rad/s\]; `None` as for [`Self::find`], so that what may be
    /// a function of the state is left to the network.
    #[must_use]
    pub fn of_frequency(recording: &Recording, row: &[f64], frequency: f64) -> Option<Self> {
        let averages =
            Averages::new(recording, row, 2).or_else(|| Averages::new(recording, row, 1))?;
        averages.harmonic(frequency)
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
        let samples =
            recording.samples.of_shape(recording.samples.inputs().to_vec(), targets).ok()?;
        Some(Recording { samples, ..recording.clone() })
    }
}

/// Averages of states and rates, with the smooth functions of the state.
struct Averages {
    times: Vec<f64>,
    /// Row by row, one column for each function.
    functions: DMatrix<f64>,
    /// Along the direction.
    rates: DVector<f64>,
    /// Standard deviation of the rates.
    deviation: f64,
}

/// A fit of the rates.
struct Fit {
    /// Of cosine and sine; 0 without a harmonic.
    amplitude: [f64; 2],
    /// Sum of the squares that are left.
    rest: f64,
}

impl Averages {
    fn new(recording: &Recording, row: &[f64], degree: usize) -> Option<Self> {
        // The rates are functions of the state and of known inputs.
        let (n, variables) = (recording.samples.dimension(), recording.samples.width());
        let (inputs, targets) = (recording.samples.inputs(), recording.samples.targets());
        let ticks = recording.ticks();
        let width = ((WINDOW / recording.interval).round() as usize).max(1);
        let stride = (width / PER_WINDOW).max(1);
        let (mut times, mut states, mut rates) = (Vec::new(), Vec::new(), Vec::new());
        for start in (0..(ticks.len() + 1).saturating_sub(width)).step_by(stride) {
            // A window does not bridge a gap.
            if ticks[start + width - 1] - ticks[start] != width as u64 - 1 {
                continue;
            }
            let mean = |values: &[f64], n: usize| -> Vec<f64> {
                let mut sum = vec![0.0; n];
                for row in values[start * n..(start + width) * n].chunks_exact(n) {
                    sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
                }
                sum.iter().map(|sum| sum / width as f64).collect()
            };
            let middle = ticks[start] as f64 + 0.5 * (width as f64 - 1.0);
            times.push(recording.start + middle * recording.interval);
            states.push(mean(inputs, variables));
            let rate = mean(targets, n);
            rates.push(row.iter().zip(&rate).fold(0.0, |sum, (row, rate)| sum + row * rate));
        }
        if times.len() < 4 * PER_WINDOW {
            return None;
        }
        if monomials(variables, degree).len() * SAMPLES_PER_FUNCTION > times.len() {
            return None;
        }
        scale(&mut states);
        let monomials = monomials(variables, degree);
        let functions = DMatrix::from_fn(times.len(), monomials.len(), |k, m| {
            monomials[m].iter().fold(1.0, |product, &c| product * states[k][c])
        });
        let rates = DVector::from_vec(rates);
        let mean = rates.mean();
        let squares = rates.iter().fold(0.0, |sum, rate| sum + (rate - mean) * (rate - mean));
        let deviation = (squares / rates.len() as f64).sqrt();
        Some(Self { times, functions, rates, deviation })
    }

    /// Returns the frequency of the harmonic that leaves least.
    fn best_frequency(&self) -> Option<f64> {
        let count = ((RANGE[1] - RANGE[0]) / GRID).ceil() as usize;
        let grid = |k: usize| RANGE[0] + k as f64 * GRID;
        let rest = |frequency: f64| self.rest(Some(frequency)).map_or(f64::MAX, |fit| fit.rest);
        let rests = (0..=count).map(|k| (k, rest(grid(k))));
        let best = rests.min_by(|a, b| a.1.total_cmp(&b.1))?.0;
        let (mut low, mut high) = (grid(best.saturating_sub(1)), grid(best + 1));
        let golden = (5f64.sqrt() - 1.0) / 2.0;
        for _ in 0..REFINEMENTS {
            let (left, right) = (high - golden * (high - low), low + golden * (high - low));
            if rest(left) < rest(right) { high = right } else { low = left }
        }
        Some(0.5 * (low + high))
    }

    /// Returns the harmonic of this frequency \[rad/s\]; `None` if it is not worth mentioning.
    fn harmonic(&self, frequency: f64) -> Option<Harmonic> {
        let (smooth, fit) = (self.rest(None)?, self.rest(Some(frequency))?);
        // Averages shrink the harmonic.
        let half = 0.5 * frequency * WINDOW;
        let shrunk = libm::sin(half) / half;
        let harmonic = Harmonic {
            frequency,
            amplitude: fit.amplitude.map(|amplitude| amplitude / shrunk),
            explained: 1.0 - fit.rest / smooth.rest,
        };
        let size = libm::hypot(harmonic.amplitude[0], harmonic.amplitude[1]) / 2f64.sqrt();
        let is_large = size >= SIZE_MIN * self.deviation;
        (is_large && harmonic.explained >= EXPLAINED_MIN).then_some(harmonic)
    }

    /// Fits the smooth functions, and a harmonic of this frequency.
    fn rest(&self, frequency: Option<f64>) -> Option<Fit> {
        let (rows, columns) = self.functions.shape();
        let harmonic = if frequency.is_some() { 2 } else { 0 };
        let mut basis = self.functions.clone().resize_horizontally(columns + harmonic, 0.0);
        if let Some(frequency) = frequency {
            for (k, time) in self.times.iter().enumerate() {
                basis[(k, columns)] = libm::cos(frequency * time);
                basis[(k, columns + 1)] = libm::sin(frequency * time);
            }
        }
        let mut normal = basis.tr_mul(&basis);
        for k in 0..normal.nrows() {
            // Functions that the path does not tell apart share what they explain.
            normal[(k, k)] *= 1.0 + RIDGE;
            normal[(k, k)] += RIDGE * rows as f64;
        }
        let solution = normal.cholesky()?.solve(&basis.tr_mul(&self.rates));
        let rest = (&self.rates - &basis * &solution).norm_squared();
        let amplitude = match frequency {
            Some(_) => [solution[columns], solution[columns + 1]],
            None => [0.0; 2],
        };
        Some(Fit { amplitude, rest })
    }
}

/// Brings every component to mean 0 and deviation 1.
fn scale(states: &mut [Vec<f64>]) {
    let count = states.len() as f64;
    for c in 0..states.first().map_or(0, Vec::len) {
        let mean = states.iter().fold(0.0, |sum, state| sum + state[c]) / count;
        let squares =
            states.iter().fold(0.0, |sum, state| sum + (state[c] - mean) * (state[c] - mean));
        let deviation = (squares / count).sqrt().max(f64::MIN_POSITIVE);
        states.iter_mut().for_each(|state| state[c] = (state[c] - mean) / deviation);
    }
}

/// Returns all products of up to `degree` of `n` components, as lists of the components.
fn monomials(n: usize, degree: usize) -> Vec<Vec<usize>> {
    let mut all = vec![Vec::new()];
    let mut last = all.clone();
    for _ in 0..degree {
        let longer = |short: &Vec<usize>| -> Vec<Vec<usize>> {
            let from = short.last().copied().unwrap_or(0);
            (from..n).map(|c| [short.as_slice(), &[c]].concat()).collect()
        };
        last = last.iter().flat_map(longer).collect();
        all.extend(last.iter().cloned());
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packages::Timing;
    use crate::training::Dataset;

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

    #[test]
    fn a_harmonic_is_found_and_taken_away() {
        for frequency in [2.5, 3.75, 6.2] {
            let recording = recording(frequency);
            let found = Harmonic::find(&recording, &[0.0, 1.0]).unwrap();
            assert!((found.frequency - frequency).abs() < 0.1, "{found:?}");
            let size = libm::hypot(found.amplitude[0], found.amplitude[1]);
            assert!((size - 0.4).abs() < 0.06, "{found:?}");
            let rest = found.taken_from(&recording, &[0.0, 1.0]).unwrap();
            let left = Harmonic::find(&rest, &[0.0, 1.0]);
            assert!(left.is_none_or(|left| left.amplitude[0].abs() < 0.02), "{left:?}");
            // The other component is as before.
            let first = |r: &Recording| -> Vec<f64> {
                r.samples.targets().iter().step_by(2).copied().collect()
            };
            assert_eq!(first(&rest), first(&recording));
        }
    }

    #[test]
    fn a_known_frequency_is_fitted_where_there_is_one() {
        let recording = recording(2.5);
        let found = Harmonic::of_frequency(&recording, &[0.0, 1.0], 2.5).unwrap();
        let size = libm::hypot(found.amplitude[0], found.amplitude[1]);
        assert!((size - 0.4).abs() < 0.02, "{found:?}");
        assert_eq!(Harmonic::of_frequency(&recording, &[1.0, 0.0], 2.5), None);
        assert_eq!(Harmonic::of_frequency(&recording, &[0.0, 1.0], 9.0), None);
    }

    #[test]
    fn nothing_is_found_where_there_is_nothing() {
        let recording = recording(3.0);
        assert_eq!(Harmonic::find(&recording, &[1.0, 0.0]), None);
        let short = Recording {
            samples: recording.samples.select(&(0..300).collect::<Vec<_>>()).unwrap(),
            gaps: Vec::new(),
            ..recording
        };
        assert_eq!(Harmonic::find(&short, &[0.0, 1.0]), None);
    }
}
