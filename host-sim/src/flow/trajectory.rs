//! States `x(t_k)` at `t_k = k dt`: what is known of the plant before the design.
//!
//! Cost: none beyond the samples, 8 bytes a number.

/// States of a plant at equal intervals.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// `n`.
    pub dimension: usize,
    /// Time between samples. \[s\]
    pub step: f64,
    /// `x(t_k)`, one row per sample, shape `[samples, n]`. \[state unit\]
    pub states: Vec<f64>,
}

impl Trajectory {
    /// Returns the number of samples.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.states.len() / self.dimension
    }

    /// Returns sample `k`, shape `[n]`. \[state unit\]
    ///
    /// # Panics
    /// If there is no such sample.
    #[must_use]
    pub fn state(&self, k: usize) -> &[f64] {
        &self.states[k * self.dimension..(k + 1) * self.dimension]
    }

    /// Returns the time of sample `k`, counted from the first. \[s\]
    #[must_use]
    pub fn time(&self, k: usize) -> f64 {
        k as f64 * self.step
    }

    /// Returns the mean of each component, shape `[n]`. \[state unit\]
    #[must_use]
    pub fn mean(&self) -> Vec<f64> {
        let mut mean = vec![0.0; self.dimension];
        for state in self.states.chunks_exact(self.dimension) {
            for (mean, x) in mean.iter_mut().zip(state) {
                *mean += x;
            }
        }
        mean.iter().map(|sum| sum / self.samples() as f64).collect()
    }

    /// Returns the largest magnitude of each component, shape `[n]`. \[state unit\]
    #[must_use]
    pub fn reach(&self) -> Vec<f64> {
        let component = |c| self.states.iter().skip(c).step_by(self.dimension);
        (0..self.dimension)
            .map(|c| component(c).fold(0.0f64, |most, x| most.max(x.abs())))
            .collect()
    }

    /// Returns the standard deviation of each component, shape `[n]`. \[state unit\]
    #[must_use]
    pub fn deviation(&self) -> Vec<f64> {
        let mean = self.mean();
        let mut squares = vec![0.0; self.dimension];
        for state in self.states.chunks_exact(self.dimension) {
            for (square, (x, mean)) in squares.iter_mut().zip(state.iter().zip(&mean)) {
                *square += (x - mean) * (x - mean);
            }
        }
        squares.iter().map(|square| (square / self.samples() as f64).sqrt()).collect()
    }
}

/// Returns deviations as units: 1 for a component that does not move.
pub(super) fn units(deviation: &[f64]) -> Vec<f64> {
    deviation.iter().map(|&unit| if unit > 0.0 && unit.is_finite() { unit } else { 1.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_a_small_trajectory() {
        let states = vec![1.0, 5.0, 3.0, 5.0];
        let trajectory = Trajectory { dimension: 2, step: 0.1, states };
        assert_eq!((trajectory.samples(), trajectory.state(1)), (2, &[3.0, 5.0][..]));
        assert_eq!(trajectory.mean(), [2.0, 5.0]);
        assert_eq!(trajectory.reach(), [3.0, 5.0]);
        assert_eq!(trajectory.deviation(), [1.0, 0.0]);
        assert_eq!(units(&trajectory.deviation()), [1.0, 1.0]);
    }
}
