//! How large the plant's state is over a run, and how much it moves in the evaluation window: what errors are compared
//! with.

/// Collects the states of a run, one step after the other.
#[derive(Clone, Debug)]
pub(super) struct StateSize {
    /// The square of the largest `|x_0|`.
    largest_squared: f64,
    /// Steps of the evaluation window so far.
    steps: u64,
    /// Mean of each component in these, shape `[n]`.
    mean: Vec<f64>,
    /// Sum of the squared distances from the mean, all components.
    squares: f64,
}

impl StateSize {
    pub(super) fn new(dimension: usize) -> Self {
        Self { largest_squared: 0.0, steps: 0, mean: vec![0.0; dimension], squares: 0.0 }
    }

    /// Adds the state of a step, shape `[n]`; `is_evaluated` says whether it is in the evaluation window.
    #[inline]
    pub(super) fn note(&mut self, state: &[f64], is_evaluated: bool) {
        let squared = state.iter().fold(0.0, |sum, x| sum + x * x);
        self.largest_squared = self.largest_squared.max(squared);
        if !is_evaluated {
            return;
        }
        self.steps += 1;
        let share = 1.0 / self.steps as f64;
        for (mean, x) in self.mean.iter_mut().zip(state) {
            let distance = x - *mean;
            *mean += share * distance;
            self.squares += distance * (x - *mean);
        }
    }

    /// Returns the largest `|x_0|`. \[state unit\]
    pub(super) fn largest(&self) -> f64 {
        self.largest_squared.sqrt()
    }

    /// Returns the root mean square of the distance from the mean state in the evaluation window; 0 if a state was not finite, as
    /// without a reference for it. \[state unit\]
    pub(super) fn deviation(&self) -> f64 {
        let deviation = (self.squares / self.steps.max(1) as f64).sqrt();
        if deviation.is_finite() { deviation } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviation_is_that_of_all_components_together() {
        let mut size = StateSize::new(2);
        assert_eq!((size.largest(), size.deviation()), (0.0, 0.0));
        [[1.0, 10.0], [3.0, 6.0]].iter().for_each(|state| size.note(state, true));
        size.note(&[20.0, 0.0], false);
        assert_eq!(size.largest(), 20.0);
        // Variances 1 and 4.
        assert_eq!(size.deviation(), 5f64.sqrt());
    }
}
