//! Recorded traces of plant and agents.

use crate::scenario::Scenario;

/// True state, every agent's estimate and its innovation, one row every `trace_stride` steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Traces {
    dimension: usize,
    agents: usize,
    time: Vec<f64>,
    truth: Vec<f64>,
    estimates: Vec<f32>,
    /// `|e_3i|` of the step at each row; shorter than the rows if not recorded.
    innovations: Vec<Option<f32>>,
}

impl Traces {
    /// Creates empty traces with room for what `scenario` records.
    pub(super) fn of(scenario: &Scenario) -> Self {
        let (dimension, agents) = (scenario.dimension(), scenario.agents.len());
        let rows = scenario
            .record
            .trace_stride
            .map_or(0, |stride| scenario.steps() / u64::from(stride.get()) + 1);
        Self::with_capacity(dimension, agents, usize::try_from(rows).unwrap_or(0))
    }

    /// Creates empty traces with room for `rows`.
    #[must_use]
    pub fn with_capacity(dimension: usize, agents: usize, rows: usize) -> Self {
        Self {
            dimension,
            agents,
            time: Vec::with_capacity(rows),
            truth: Vec::with_capacity(rows * dimension),
            estimates: Vec::with_capacity(rows * dimension * agents),
            innovations: Vec::new(),
        }
    }

    /// Adds a row: time \[s\], `x_0` (shape `[n]`), and all `x_hat_i` (each of shape `[n]`).
    pub fn push<'e>(
        &mut self,
        time: f64,
        truth: &[f64],
        estimates: impl Iterator<Item = &'e [f32]>,
    ) {
        self.time.push(time);
        self.truth.extend_from_slice(truth);
        estimates.for_each(|estimate| self.estimates.extend_from_slice(estimate));
    }

    /// Adds `|e_3i|` of the step that begins at the last row, for each agent; `None` for one without a
    /// measurement. The last row of a run has none. \[output unit\]
    pub fn push_innovations(&mut self, innovations: impl Iterator<Item = Option<f32>>) {
        self.innovations.extend(innovations);
    }

    /// Returns `|e_3i|` of the step in a row, agents counting from 0; `None` if it was not measured or not recorded.
    /// \[output unit\]
    #[must_use]
    pub fn innovation(&self, row: usize, agent: usize) -> Option<f32> {
        self.innovations.get(row * self.agents + agent).copied().flatten()
    }

    /// Returns whether innovations were recorded.
    #[must_use]
    pub fn has_innovations(&self) -> bool {
        !self.innovations.is_empty()
    }

    /// Returns the number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.time.len()
    }

    /// Returns `n`, the number of state components.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// Returns `N`, the number of agents.
    #[must_use]
    pub fn agents(&self) -> usize {
        self.agents
    }

    /// Returns the time of each row. \[s\]
    #[must_use]
    pub fn time(&self) -> &[f64] {
        &self.time
    }

    /// Returns `x_0` in a row, shape `[n]`.
    #[must_use]
    pub fn truth(&self, row: usize) -> &[f64] {
        &self.truth[row * self.dimension..][..self.dimension]
    }

    /// Returns `x_hat_i` in a row, agents from 0, shape `[n]`.
    #[must_use]
    pub fn estimate(&self, row: usize, agent: usize) -> &[f32] {
        &self.estimates[(row * self.agents + agent) * self.dimension..][..self.dimension]
    }

    /// Returns `|e_1i|` in a row, agents from 0.
    #[must_use]
    pub fn error(&self, row: usize, agent: usize) -> f64 {
        squared_error(self.estimate(row, agent), self.truth(row)).sqrt()
    }
}

/// Returns `|x_hat - x_0|^2`.
#[inline]
#[must_use]
pub fn squared_error(estimate: &[f32], truth: &[f64]) -> f64 {
    estimate.iter().zip(truth).fold(0.0, |sum, (&estimate, &truth)| {
        let error = f64::from(estimate) - truth;
        sum + error * error
    })
}
