//! A random disturbance: an Ornstein-Uhlenbeck process in each component of the state.
//!
//! With the standard deviation `s`, the correlation time `T`, the step `h` and independent normal numbers `g_k`,
//!
//! ```text
//! d_0 = s g_0,   d_{k+1} = a d_k + s sqrt(1 - a^2) g_{k+1},   a = exp(-h / T)
//! ```
//!
//! which has the variance `s^2` and the autocorrelation `exp(-|t| / T)` of the process at the steps, exactly. In
//! between it is interpolated, so it is continuous.
//!
//! A path is a pure function of the run's seed, of the step's length and of what is given here; the numbers of a
//! component do not depend on those of others.

use std::sync::Arc;

use crate::random::{Purpose, Random};

/// An Ornstein-Uhlenbeck process, and its path in a run.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomDisturbance {
    /// Standard deviation, shape `[n]`. \[state unit/s\]
    deviation: Vec<f64>,
    /// \[s\]
    correlation_time: f64,
    path: Option<Path>,
}

/// The path of one seed.
#[derive(Clone, Debug, PartialEq)]
struct Path {
    seed: u64,
    /// \[s\]
    step_size: f64,
    /// `d` at every step, shape `[steps + 1][n]`.
    values: Arc<[f64]>,
}

impl RandomDisturbance {
    /// Limit for the numbers of a path, 128 MiB: runs that are carried out together have one each.
    pub const NUMBERS_MAX: u64 = 1 << 24;

    /// Creates a process without a path. `deviation` has the shape `[n]` and the unit of the state per second;
    /// `correlation_time` is in s.
    #[must_use]
    pub fn new(deviation: Vec<f64>, correlation_time: f64) -> Self {
        Self { deviation, correlation_time, path: None }
    }

    /// Draws the path of a run with this seed and `steps` steps of `step_size` \[s\]; `None` if it is drawn already.
    #[must_use]
    pub fn drawn(&self, seed: u64, step_size: f64, steps: u64) -> Option<Self> {
        let n = self.deviation.len();
        let is_drawn = |path: &Path| {
            let is_complete = path.values.len() as u64 == (steps + 1) * n as u64;
            is_complete && path.seed == seed && path.step_size == step_size
        };
        if self.path.as_ref().is_some_and(is_drawn) {
            return None;
        }
        let random = Random::new(seed, Purpose::Disturbance);
        let kept = libm::exp(-step_size / self.correlation_time);
        // 1 - a^2, without cancellation.
        let innovation = (-libm::expm1(-2.0 * step_size / self.correlation_time)).sqrt();
        let mut d = vec![0.0; n];
        let mut values = Vec::with_capacity((steps as usize + 1) * n);
        for tick in 0..=steps {
            for ((component, d), deviation) in d.iter_mut().enumerate().zip(&self.deviation) {
                let number = deviation * random.normal([0, component as u64, tick]);
                *d = if tick == 0 { number } else { kept * *d + innovation * number };
            }
            values.extend_from_slice(&d);
        }
        let path = Some(Path { seed, step_size, values: values.into() });
        Some(Self { path, ..self.clone() })
    }

    /// Writes `d` at `time` \[s\] to `d`, shape `[n]`. Before the first and after the last step it stays as it is
    /// there.
    ///
    /// # Panics
    /// If no path has been drawn.
    #[inline]
    pub(super) fn evaluate(&self, time: f64, d: &mut [f64]) {
        let path = self.path.as_ref().expect("a run draws its random disturbance first");
        let n = self.deviation.len();
        let last = path.values.len() / n - 1;
        let position = (time / path.step_size).max(0.0);
        let tick = (position as usize).min(last);
        let part = if tick == last { 0.0 } else { position - tick as f64 };
        let before = &path.values[tick * n..][..n];
        let after = &path.values[(tick + 1).min(last) * n..][..n];
        for ((d, before), after) in d.iter_mut().zip(before).zip(after) {
            *d = before + part * (after - before);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn process(deviation: &[f64], steps: u64, seed: u64) -> RandomDisturbance {
        RandomDisturbance::new(deviation.to_vec(), 0.25).drawn(seed, 0.01, steps).unwrap()
    }

    fn values(process: &RandomDisturbance) -> &[f64] {
        &process.path.as_ref().unwrap().values
    }

    #[test]
    fn deviation_and_correlation_are_those_asked_for() {
        let process = process(&[0.5, 2.0], 200_000, 7);
        for component in 0..2 {
            let path: Vec<f64> =
                values(&process).iter().skip(component).step_by(2).copied().collect();
            let mean_product = |lag: usize| {
                let products = path.iter().zip(&path[lag..]).map(|(a, b)| a * b);
                products.sum::<f64>() / (path.len() - lag) as f64
            };
            let variance = process.deviation[component].powi(2);
            // 2,000 s are 4,000 independent values: the standard error is 2 to 3 %.
            assert!((mean_product(0) / variance - 1.0).abs() < 0.1, "{}", mean_product(0));
            let correlation = mean_product(25) / mean_product(0);
            assert!((correlation - libm::exp(-1.0)).abs() < 0.05, "{correlation}");
        }
    }

    #[test]
    fn a_path_is_continuous_and_depends_on_seed_and_run_alone() {
        let process = process(&[0.5, 2.0], 100, 7);
        let at = |time: f64| {
            let mut d = [0.0; 2];
            process.evaluate(time, &mut d);
            d
        };
        let path = values(&process);
        let [first, second] = [at(0.0), at(0.01)];
        assert_eq!(first, path[..2]);
        assert!((second[0] - path[2]).abs() < 1e-12);
        assert!((at(0.005)[1] - 0.5 * (first[1] + second[1])).abs() < 1e-12);
        assert_eq!((at(-1.0), &at(1e9)[..]), (first, &path[path.len() - 2..]));
        assert_eq!(process.drawn(7, 0.01, 100), None);
        let other = process.drawn(8, 0.01, 100).unwrap();
        assert_ne!(other, process);
        assert_eq!(other.drawn(7, 0.01, 100), Some(process.clone()));
        // A longer run begins with the same path.
        let longer = process.drawn(7, 0.01, 200).unwrap();
        assert_eq!(&values(&longer)[..path.len()], path);
        assert_eq!(values(&longer).len(), 402);
        // The second component does not change that of the first.
        assert_eq!(values(&self::process(&[0.5], 10, 7))[10], path[20]);
    }
}
