//! How well the package in use performs: mean squares of what its node can see of the error.
//!
//! Three quantities, none of which needs the plant's true state:
//! - the innovation `e_3 = C x_hat - y`, over steps and outputs;
//! - the disagreement: the squared distance of the estimate from the held samples of the agent's
//!   neighbours, over those that have been heard, plus that from the agent's own held sample. It
//!   shows errors in components that the agent does not measure, and an agent that no longer tells
//!   its neighbours. It contains no parameter of the package;
//! - broadcasts per step;
//! - the effort of the feedback: how fast the estimate moved over a block, less what the network
//!   predicted. A perfect network needs none, whatever the gains. It shows a bad network in components
//!   that the agent does not measure and in which its neighbours follow it.
//!
//! Steps are collected in blocks of [`BLOCK`]. The innovation is summed in every step; the
//! disagreement and the size of the output are sampled at the end of a block. Sums are f32 in a
//! fixed order, first within a block and then over blocks, so a long run does not stagnate. An
//! overflow gives infinity or NaN, and every comparison here and in [`super::Trial`] treats both as
//! bad.
//!
//! Cost per step: `2 m` operations. Memory: `72 + 8 N` bytes.

use super::Tally;
use crate::StateVector;
use crate::agent::hold::{Hold, HoldSlots};
use crate::agent::{AgentParams, AgentState};
use crate::math::numeric::{components, difference};

/// Steps in a block.
pub const BLOCK: u32 = 64;

/// Blocks that are left out after a start or a fault, while the estimate converges.
const SETTLING: u32 = 16;

/// Mean values over some blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Means {
    /// Mean square of the innovation. \[squared output unit\]
    pub innovation: f32,
    /// Mean squared disagreement; 0 if no neighbour has been heard. \[squared state unit\]
    pub disagreement: f32,
    /// Fraction of the samples of the disagreement at which a neighbour had been heard.
    pub heard: f32,
    /// Broadcasts per step.
    pub broadcasts: f32,
    /// Mean square of the effort. \[squared state unit/s\]
    pub effort: f32,
    /// Mean square of the measurements. \[squared output unit\]
    pub output: f32,
    /// Fraction of the blocks with a fault, such as an estimate outside the trained box.
    pub faults: f32,
}

/// One block of steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Block {
    /// Steps taken with a measurement.
    pub taken: u32,
    /// Means over the steps taken.
    pub means: Means,
}

/// The running record of the package in use.
#[derive(Clone, Copy, Debug)]
pub struct Performance<const N: usize> {
    attempts: u32,
    taken: u32,
    broadcasts: u32,
    squares: f32,
    means: Means,
    /// Blocks in the means.
    blocks: u32,
    settling: u32,
    /// Blocks that the means look back.
    memory: u32,
    step_size: f32,
    /// At the end of the last block: estimate, and what the network predicted.
    last: Option<(StateVector<N>, StateVector<N>)>,
}

impl<const N: usize> Performance<N> {
    /// Creates an empty record that looks back `seconds` \[s\] of steps of `step_size` \[s\], at
    /// least 16 and at most 4096 blocks.
    #[must_use]
    pub fn new(seconds: u32, step_size: f32) -> Self {
        Self {
            attempts: 0,
            taken: 0,
            broadcasts: 0,
            squares: 0.0,
            means: Means::default(),
            blocks: 0,
            settling: SETTLING,
            memory: blocks_in(seconds, step_size).clamp(16, 4096),
            step_size,
            last: None,
        }
    }

    /// Records an attempted step; `output_error` is `e_3` if it was taken with a measurement.
    /// Returns whether it was the last of a block: then call [`Self::end_block`].
    #[inline]
    pub fn observe(&mut self, output_error: Option<&[f32]>, broadcast: bool) -> bool {
        self.attempts = self.attempts.wrapping_add(1);
        self.broadcasts = self.broadcasts.wrapping_add(u32::from(broadcast));
        if let Some(output_error) = output_error {
            self.taken = self.taken.wrapping_add(1);
            self.squares += sum_of_squares(output_error);
        }
        self.attempts >= BLOCK
    }

    /// Ends a block and returns it. `tally` is what happened in it: a block with a restart, an overflow
    /// or a chip that stalled is not part of the means, nor are the ones in which the estimate
    /// converges again.
    /// `params` and `state` are the agent's; `last` is the last step: its measurement and the
    /// derivative, if it was taken with one.
    #[inline(never)]
    pub fn end_block<const FEATURES: usize, S: HoldSlots<N>>(
        &mut self,
        params: &AgentParams<'_, N>,
        state: &AgentState<N, FEATURES, S>,
        last: Option<(&[f32], &StateVector<N>)>,
        tally: &Tally,
    ) -> Block {
        let measurement = last.map_or(&[][..], |(measurement, _)| measurement);
        let disagreement = disagreement(state);
        let outputs = measurement.len().max(1) as f32;
        let predicted = last.map(|(_, derivative)| {
            (*state.estimate(), difference(derivative, &state.feedback(params)))
        });
        let effort = match (&self.last, &predicted) {
            (Some((from, before)), Some((to, after))) => {
                let time = BLOCK as f32 * self.step_size;
                let moved = components(from).iter().zip(components(to));
                let expected = components(before).iter().zip(components(after));
                moved.zip(expected).fold(0.0, |sum, ((from, to), (before, after))| {
                    let effort = (to - from) / time - 0.5 * (before + after);
                    sum + effort * effort
                })
            }
            _ => self.means.effort,
        };
        self.last = predicted;
        let means = Means {
            innovation: self.squares / (self.taken.max(1) as f32 * outputs),
            disagreement: disagreement.unwrap_or(0.0),
            heard: if disagreement.is_some() { 1.0 } else { 0.0 },
            broadcasts: self.broadcasts as f32 / BLOCK as f32,
            effort,
            output: sum_of_squares(measurement) / outputs,
            faults: if tally.faults > 0 { 1.0 } else { 0.0 },
        };
        let block = Block { taken: self.taken, means };
        (self.attempts, self.taken, self.broadcasts, self.squares) = (0, 0, 0, 0.0);
        let is_lost = tally.restarts > 0 || tally.overflows > 0 || tally.stalled_ticks > 0;
        if is_lost || !means.innovation.is_finite() || !means.disagreement.is_finite() {
            self.settling = SETTLING;
        } else if self.settling > 0 {
            self.settling -= 1;
        } else if block.is_whole() {
            self.blocks = self.blocks.saturating_add(1);
            let weight = 1.0 / self.blocks.min(self.memory) as f32;
            self.means.approach(&means, weight);
        }
        block
    }

    /// Returns the means, or `None` until enough blocks without a fault have been recorded: a quarter of
    /// the time over which the record looks back.
    #[must_use]
    pub fn reference(&self) -> Option<Means> {
        (self.blocks >= self.memory / 4).then_some(self.means)
    }

    /// Returns the means so far; `None` before the first block.
    #[must_use]
    pub fn means(&self) -> Option<&Means> {
        (self.blocks > 0).then_some(&self.means)
    }
}

impl Block {
    /// Returns whether most of its steps were taken with a measurement.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        2 * self.taken >= BLOCK
    }
}

impl Means {
    /// Adds the means of a block to sums over blocks.
    pub(super) fn add(&mut self, other: &Self) {
        for (sum, value) in self.each(other) {
            *sum += value;
        }
    }

    fn approach(&mut self, other: &Self, weight: f32) {
        for (mean, value) in self.each(other) {
            *mean += weight * (value - *mean);
        }
    }

    fn each(&mut self, other: &Self) -> [(&mut f32, f32); 7] {
        [
            (&mut self.innovation, other.innovation),
            (&mut self.disagreement, other.disagreement),
            (&mut self.heard, other.heard),
            (&mut self.broadcasts, other.broadcasts),
            (&mut self.effort, other.effort),
            (&mut self.output, other.output),
            (&mut self.faults, other.faults),
        ]
    }
}

/// Returns the disagreement of an agent with its neighbours: see the module documentation; `None` if
/// none of its neighbours has been heard.
#[must_use]
pub fn disagreement<const N: usize, const FEATURES: usize, S: HoldSlots<N>>(
    state: &AgentState<N, FEATURES, S>,
) -> Option<f32> {
    let distance = |hold: &Hold<N>| -> f32 {
        let apart: StateVector<N> = difference(hold.estimate(), state.estimate());
        sum_of_squares(components(&apart))
    };
    let (mut sum, mut heard) = (0.0, 0_u32);
    for hold in state.neighbour_holds().iter().filter_map(Hold::present) {
        sum += distance(hold);
        heard += 1;
    }
    (heard > 0).then(|| sum / heard as f32 + distance(state.own_hold()))
}

/// Returns the number of blocks in `seconds` \[s\] of steps of `step_size` \[s\], rounded up, at
/// least 1.
pub(super) fn blocks_in(seconds: u32, step_size: f32) -> u32 {
    // The conversion saturates and maps NaN to 0.
    let blocks = (seconds as f32 / (step_size * BLOCK as f32)) as u32;
    blocks.saturating_add(1).min(u32::MAX / (4 * BLOCK))
}

fn sum_of_squares(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |sum, value| sum + value * value)
}
