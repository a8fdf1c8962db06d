//! A disturbance that is random: an Ornstein-Uhlenbeck process in each component of the state.
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

/// An Ornstein-Uhlenbeck process, and its path for one seed.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomDisturbance {
    /// Standard deviation, shape `[n]`. \[state unit/s\]
    deviation: Vec<f64>,
    /// \[s\]
    correlation_time: f64,
    /// \[s\]
    step_size: f64,
    /// `d` at every step, shape `[steps + 1][n]`.
    path: Arc<[f64]>,
}

impl RandomDisturbance {
    /// Draws the path with this seed for `steps` steps of a length \[s\]. `deviation` has the shape `[n]` and the
    /// unit of the state per second; `correlation_time` is in s.
    #[must_use]
    pub fn new(
        deviation: Vec<f64>,
        correlation_time: f64,
        (step_size, steps): (f64, u64),
        seed: u64,
    ) -> Self {
        let random = Random::new(seed, Purpose::Disturbance);
        let kept = libm::exp(-step_size / correlation_time);
        // 1 - a^2, without cancellation.
        let drawn = (-libm::expm1(-2.0 * step_size / correlation_time)).sqrt();
        let mut path = Vec::with_capacity((steps as usize + 1) * deviation.len());
        let mut d = vec![0.0; deviation.len()];
        for tick in 0..=steps {
            for ((component, d), deviation) in d.iter_mut().enumerate().zip(&deviation) {
                let number = deviation * random.normal([0, component as u64, tick]);
                *d = if tick == 0 { number } else { kept * *d + drawn * number };
            }
            path.extend_from_slice(&d);
        }
        Self { deviation, correlation_time, step_size, path: path.into() }
    }

    /// Returns the same process with the path of another seed.
    #[must_use]
    pub fn drawn(&self, seed: u64) -> Self {
        let steps = (self.path.len() / self.deviation.len() - 1) as u64;
        let steps = (self.step_size, steps);
        Self::new(self.deviation.clone(), self.correlation_time, steps, seed)
    }

    /// Writes `d` at `time` \[s\] to `d`, shape `[n]`. Before the first and after the last step it stays as it is
    /// there.
    #[inline]
    pub(super) fn evaluate(&self, time: f64, d: &mut [f64]) {
        let n = self.deviation.len();
        let last = self.path.len() / n - 1;
        let position = (time / self.step_size).max(0.0);
        let tick = (position as usize).min(last);
        let part = if tick == last { 0.0 } else { position - tick as f64 };
        let before = &self.path[tick * n..][..n];
        let after = &self.path[(tick + 1).min(last) * n..][..n];
        for ((d, before), after) in d.iter_mut().zip(before).zip(after) {
            *d = before + part * (after - before);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn process(seed: u64) -> RandomDisturbance {
        RandomDisturbance::new(vec![0.5, 2.0], 0.25, (0.01, 200_000), seed)
    }

    #[test]
    fn deviation_and_correlation_are_those_asked_for() {
        let process = process(7);
        for component in 0..2 {
            let path: Vec<f64> = process.path.iter().skip(component).step_by(2).copied().collect();
            let mean_product = |lag: usize| {
                let products = path.iter().zip(&path[lag..]).map(|(a, b)| a * b);
                products.sum::<f64>() / (path.len() - lag) as f64
            };
            let variance = process.deviation[component].powi(2);
            // 2,000 s are 4,000 independent values: the standard error is 2 to 3 %.
            assert!((mean_product(0) / variance - 1.0).abs() < 0.1, "{}", mean_product(0));
            let correlation = mean_product(25) / mean_product(0);
            assert!((correlation - (-1.0_f64).exp()).abs() < 0.05, "{correlation}");
        }
    }

    #[test]
    fn a_path_is_continuous_and_depends_on_the_seed_alone() {
        let process = process(7);
        let at = |time: f64| {
            let mut d = [0.0; 2];
            process.evaluate(time, &mut d);
            d
        };
        let [first, second] = [at(0.0), at(0.01)];
        assert_eq!(first, process.path[..2]);
        assert!((second[0] - process.path[2]).abs() < 1e-12);
        assert!((at(0.005)[1] - 0.5 * (first[1] + second[1])).abs() < 1e-12);
        assert_eq!(at(-1.0), first);
        assert_eq!(at(1e9), process.path[process.path.len() - 2..]);
        assert_eq!(self::process(8).drawn(7), process);
        assert_ne!(self::process(8), process);
        // The second component does not change that of the first.
        let alone = RandomDisturbance::new(vec![0.5], 0.25, (0.01, 10), 7);
        assert_eq!(alone.path[10], process.path[20]);
    }
}
