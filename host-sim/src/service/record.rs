//! A node's samples `(x_hat, d/dt x_hat)`, for training.
//!
//! A state that a node tells holds `x_hat` *after* its step and the derivative *of* the step. So a
//! sample is made of two states in a row, and a recording of states needs every one of them. Where
//! the line is too slow for that, the node's own samples take their place: it keeps one in so many
//! steps, and is asked for them.

use std::path::Path;

use agent_core::Tick;
use agent_core::service::State;

use crate::output_file::OutputError;
use crate::packages::recording::write_samples;
use crate::training::Dataset;

/// Samples that have been recorded.
#[derive(Clone, Debug, Default)]
pub struct Recorder {
    ticks: Vec<Tick>,
    inputs: Vec<f64>,
    targets: Vec<f64>,
    dimension: usize,
    /// `x_hat` at the beginning of a tick.
    before: Option<(Tick, Vec<f32>)>,
    outer_weights: Vec<f32>,
}

impl Recorder {
    /// How many samples there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ticks.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ticks.is_empty()
    }

    /// Takes a state: a sample with the state before it, and its outer weights.
    pub fn state(&mut self, state: &State<Vec<f32>>) {
        if let Some((tick, estimate)) = self.before.take()
            && tick == state.tick
        {
            self.sample(tick, &estimate, &state.derivative);
        }
        self.before = Some((state.tick + 1, state.estimate.clone()));
        self.weights(state);
    }

    /// Takes the outer weights of a state only.
    pub fn weights(&mut self, state: &State<Vec<f32>>) {
        if !state.outer_weights.is_empty() {
            self.outer_weights.clone_from(&state.outer_weights);
        }
    }

    /// Takes a sample, unless it is none, or not after the one before.
    pub fn sample(&mut self, tick: Tick, estimate: &[f32], derivative: &[f32]) {
        let n = estimate.len();
        let fits = n > 0 && n == derivative.len() && (self.is_empty() || n == self.dimension);
        if fits && self.ticks.last().is_none_or(|&last| tick > last) {
            self.dimension = n;
            self.ticks.push(tick);
            self.inputs.extend(estimate.iter().map(|&x| f64::from(x)));
            self.targets.extend(derivative.iter().map(|&x| f64::from(x)));
        }
    }

    /// The tick from which on the next sample is wanted.
    #[must_use]
    pub fn next_tick(&self) -> Tick {
        self.ticks.last().map_or(0, |last| last + 1)
    }

    /// Writes the file that `train` reads; steps have `step_size` \[s\]. Returns whether there is
    /// anything to write.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn save(&self, path: &Path, step_size: f64) -> Result<bool, OutputError> {
        let samples = Dataset::new(self.dimension, self.inputs.clone(), self.targets.clone());
        let Ok(samples) = samples else { return Ok(false) };
        let time = |index: usize| self.ticks[index] as f64 * step_size;
        write_samples(path, &samples, time, &self.outer_weights)?;
        Ok(true)
    }
}

/// `dt` as the scenario has it, of the single precision that a node has: the number with the fewest
/// digits that a node would have rounded to the same. \[s\]
#[must_use]
pub fn step_size(on_node: f32) -> f64 {
    // The shortest decimal that is this f32 is what somebody wrote.
    on_node.to_string().parse().unwrap_or_else(|_| f64::from(on_node))
}

#[cfg(test)]
mod tests {
    use agent_core::service::Outcome;

    use super::*;
    use crate::packages::Recording;

    fn state(tick: Tick) -> State<Vec<f32>> {
        let number = tick as f32;
        State {
            tick,
            outcome: Outcome::Stepped,
            estimate: vec![number, 0.5],
            derivative: vec![-number, 2.0],
            outer_weights: vec![number; 4],
        }
    }

    #[test]
    fn states_in_a_row_become_samples_and_a_missing_one_a_gap() {
        let mut recorder = Recorder::default();
        for tick in [10, 11, 12, 13, 16, 17, 18, 19] {
            recorder.state(&state(tick));
        }
        // The estimate is that of the state before, the derivative that of the state.
        assert_eq!(recorder.ticks, [11, 12, 13, 17, 18, 19]);
        assert_eq!((recorder.inputs[0], recorder.targets[0]), (10.0, -11.0));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        assert!(recorder.save(&path, step_size(1e-3)).unwrap());
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.samples.len(), read.gaps.clone()), (6, vec![3]));
        assert_eq!((read.start, read.outer_weights), (0.011, Some(vec![19.0; 4])));
    }

    #[test]
    fn nothing_is_written_without_samples() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        assert!(!Recorder::default().save(&path, 1e-3).unwrap());
        assert!(!path.exists());
    }
}
