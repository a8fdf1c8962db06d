//! `plant.initial_state`: given, or drawn with the run's seed.
//!
//! A component is uniform within plus and minus its half width. It is a pure function of the seed,
//! the number of the state and the component, so it depends on nothing else in the scenario.

use super::error::ScenarioError;
use super::reader::{STATE, Value};
use crate::random::{Purpose, Random};

/// What `plant.initial_state` says.
pub(super) struct InitialState {
    /// `x_0(0)`, shape `[n]`; if it is drawn, the one of seed 0.
    pub(super) state: Vec<f64>,
    /// The half widths that it is drawn from, shape `[n]`.
    pub(super) spread: Option<Vec<f64>>,
}

impl InitialState {
    /// Reads a list of `n` numbers, or `{ random = half widths }`.
    pub(super) fn read(value: &Value<'_>, n: usize) -> Result<Self, ScenarioError> {
        if !value.is_table() {
            return Ok(Self { state: value.numbers_of(n, STATE)?, spread: None });
        }
        let table = value.table()?;
        table.only(&["random"])?;
        let random = table.require("random", "[5.0, 8.0]")?;
        let spread = random.numbers_of(n, STATE)?;
        if spread.iter().any(|&width| width < 0.0) {
            let hint = "write the half width of each component, numbers >= 0";
            return Err(random.error("has a number below 0", hint));
        }
        Ok(Self { state: drawn_state(&spread, 0, 0), spread: Some(spread) })
    }
}

/// Draws an initial state within plus and minus these half widths. State 0 is the one that a run with
/// this seed begins in; studies number further ones from 1.
#[must_use]
pub fn drawn_state(half_widths: &[f64], seed: u64, number: u64) -> Vec<f64> {
    let random = Random::new(seed, Purpose::InitialState);
    let component =
        |(c, width): (usize, &f64)| width * (2.0 * random.uniform([number, c as u64, 0]) - 1.0);
    half_widths.iter().enumerate().map(component).collect()
}
