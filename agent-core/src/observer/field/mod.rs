//! The field observer: what each agent knows best spreads along trees, with few broadcasts.
//!
//! In coordinates `xi = T x`, in which every direction is measured by some agent:
//!
//! - a *root* of direction `c` measures it:
//!   `d/dt xi_hat_c = (T f_hat)_c + d_hat_c + k_c nu`, `nu = s y_o - xi_hat_c`;
//! - any other agent follows its parent in the direction's tree:
//!   `d/dt xi_hat_c = (T f_hat)_c + d_c + K_c (xi_tilde_c - xi_hat_c)`, with sample and disturbance as
//!   the parent announced them.
//!
//! Three ways to couple agents ([`Coupling`]): the paper's, the paper's with the agent's own current
//! estimate, and trees. A sample evolves between broadcasts as its sender says ([`HoldKind`]); a root
//! estimates the disturbance of its direction ([`disturbance`]). `docs/field-observer.md` derives all of
//! it and says what is certified.
//!
//! Parameters are computed on the host and shipped in a section of the package; this module decodes
//! and checks them. Memory: [`FieldParams`] takes `8 N^2 + 52 N + 20` bytes.

pub mod disturbance;
mod words;

pub use crate::wire::announced::{Announced, Disturbance, HoldKind};
pub use words::{DirectionWords, FieldWords, words_length};

use nalgebra::SMatrix;

use crate::math::numeric::{components, components_mut, unrolled, zeros};
use crate::math::parameter::ParameterError;
use crate::wire::frame::WORDS_MAX;
use crate::{NODE_DIMENSION_MAX, StateVector};

/// How an agent's estimate is coupled to its neighbours' samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Coupling {
    /// `z_i = sum_j a_ij (x_tilde_j - x_tilde_i)`, as in the paper.
    #[default]
    Held,
    /// `z_i = sum_j a_ij (x_tilde_j - x_hat_i)`: the agent's own current estimate.
    Current,
    /// Each direction follows its parent in a tree that starts at an agent that measures it.
    Trees,
}

impl Coupling {
    /// All couplings, by their numbers in packages.
    pub const ALL: [Self; 3] = [Self::Held, Self::Current, Self::Trees];
}

/// What an agent does in one direction `xi_c`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Direction {
    /// The output that measures it, if the agent is a root; `xi_c = scale * y_output`.
    pub output: Option<u8>,
    /// The neighbour that the agent follows, by its place in the parameters.
    pub parent: Option<u8>,
    /// The neighbour that it follows if the parent is silent for longer than the time-out.
    pub spare: Option<u8>,
    /// Whether a neighbour follows this agent.
    pub is_announced: bool,
    /// Factor from the output to `xi_c`.
    pub scale: f32,
    /// `k_c`, gain of the agent's own innovation. \[1/s\]
    pub root_gain: f32,
    /// `K_c`, gain towards neighbours' samples. \[1/s\]
    pub tree_gain: f32,
    /// Deviation of the agent's own sample at which a broadcast is due. \[unit of `xi`\]
    pub radius: f32,
    /// The disturbance model; used by a root.
    pub model: disturbance::Model,
}

/// What holds for all directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Tells whether two agents predict samples in the same way: a digest of the network, its outer
    /// weights, and the coordinates.
    pub digest: u16,
    /// How the agent's samples evolve.
    pub hold: HoldKind,
    /// How the agent is coupled.
    pub coupling: Coupling,
    /// Whether the network is used.
    pub uses_network: bool,
    /// Whether the outer weights adapt.
    pub adapts: bool,
    /// Whether disturbances have a harmonic part.
    pub has_harmonics: bool,
    /// Whether numbers are sent in half precision.
    pub is_half: bool,
    /// Age of a parent's sample at which the agent switches to the spare parent; 0 for never. \[step\]
    pub timeout: u32,
    /// Part of an announced bias that is left after a step.
    pub bias_kept: f32,
    /// Share of the radius at which a relay passes on its parent's sample.
    pub relay_share: f32,
}

/// The field observer's parameters of one agent.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldParams<const N: usize> {
    /// What holds for all directions.
    pub options: Options,
    /// `T`, shape `[N, N]`.
    pub transform: SMatrix<f32, N, N>,
    /// `T^-1`.
    pub inverse: SMatrix<f32, N, N>,
    /// Limits of the network's inputs and of held samples. \[state unit\]
    pub low: StateVector<N>,
    /// Upper limits.
    pub high: StateVector<N>,
    /// The directions.
    pub directions: [Direction; N],
}

impl<const N: usize> FieldParams<N> {
    /// Checks the parameters for an agent with this many outputs and neighbours, stepped every
    /// `step_size` \[s\].
    ///
    /// # Errors
    /// The first parameter out of its range; gains too large for the step; coordinates whose inverse
    /// does not belong to them; an announcement that does not fit into a frame.
    pub fn validate(
        &self,
        outputs: usize,
        neighbours: usize,
        step_size: f32,
    ) -> Result<(), ParameterError> {
        let mut fault = None;
        // Not numbers fail every comparison.
        let mut require = |holds: bool, value: f32, expected| {
            if !holds && fault.is_none() {
                fault = Some((value, expected));
            }
        };
        let Options { bias_kept, relay_share, has_harmonics, is_half, hold, .. } = self.options;
        let within = |value: f32, low: f32, high: f32| low <= value && value <= high;
        require(within(bias_kept, 0.0, 1.0), bias_kept, "a kept bias from 0 to 1");
        require(within(relay_share, f32::MIN_POSITIVE, 1.0), relay_share, "a share up to 1");
        for (&low, &high) in components(&self.low).iter().zip(components(&self.high)) {
            require(low <= high, low, "limits in order");
        }
        let mut announced = 0;
        for direction in &self.directions {
            let Direction { root_gain, tree_gain, radius, model, .. } = *direction;
            for gain in [root_gain, tree_gain] {
                // Euler's method would diverge beyond.
                require(gain >= 0.0 && gain * step_size < 2.0, gain, "a gain below 2 / step_size");
            }
            require(radius > 0.0, radius, "a radius above 0");
            let positive = model.clip >= 0.0 && model.bias_gain >= 0.0;
            require(positive, model.clip, "a clip and a gain of 0 or above");
            let rotation = model.rotation_square();
            // A rotation that grows would be an oscillation that grows.
            require(within(rotation, 0.999_99, 1.000_001), rotation, "a rotation");
            let output = direction.output.map_or(0, |output| usize::from(output) + 1);
            require(output <= outputs, output as f32, "an output of the agent");
            for place in [direction.parent, direction.spare].into_iter().flatten() {
                require(usize::from(place) < neighbours, place.into(), "a neighbour's place");
            }
            announced += usize::from(direction.is_announced && model.clip > 0.0);
        }
        require(N <= NODE_DIMENSION_MAX, N as f32, "at most 12 state components");
        let rates = if hold == HoldKind::ZeroOrder { 0 } else { N };
        let words = Announced::<N>::words_for(rates, announced, has_harmonics, is_half);
        require(words <= WORDS_MAX, words as f32, "at most 17 words in a frame");
        let (is_inverse, entry) = self.is_inverse();
        require(is_inverse, entry, "the inverse of the transform");
        match fault {
            None => Ok(()),
            Some((value, expected)) => {
                Err(ParameterError::OutOfRange { parameter: "field", value, expected })
            }
        }
    }

    /// Whether `T T^-1` is the identity, to within rounding error; if not, with an entry that is wrong.
    #[inline(never)]
    fn is_inverse(&self) -> (bool, f32) {
        for (column, inverse) in self.inverse.data.0.iter().enumerate() {
            for row in 0..N {
                let mut entry = 0.0;
                let mut size = 1.0;
                for (transform, inverse) in self.transform.data.0.iter().zip(inverse) {
                    let term = transform.get(row).copied().unwrap_or(0.0) * inverse;
                    entry += term;
                    size += term.abs();
                }
                let expected = if row == column { 1.0 } else { 0.0 };
                let error = (entry - expected).abs();
                // False for numbers that are not finite, too.
                let is_small = error <= 1e-4 * size;
                if !is_small {
                    return (false, entry);
                }
            }
        }
        (true, 1.0)
    }

    /// Returns `xi_c` of a state.
    #[inline(never)]
    #[must_use]
    pub fn coordinate(&self, c: usize, state: &StateVector<N>) -> f32 {
        let (columns, values) = (&self.transform.data.0, components(state));
        let mut sum = 0.0;
        if c < N {
            unrolled!(lane < N, { sum += columns[lane][c] * values[lane] });
        }
        sum
    }

    /// Returns the state within the limits, component by component.
    #[inline(never)]
    #[must_use]
    pub fn limited(&self, state: &StateVector<N>) -> StateVector<N> {
        let mut limited = *state;
        let (low, high) = (components(&self.low), components(&self.high));
        let values = components_mut(&mut limited);
        unrolled!(lane < N, {
            let value = values[lane];
            values[lane] = if value < low[lane] {
                low[lane]
            } else if value > high[lane] {
                high[lane]
            } else {
                value
            };
        });
        limited
    }

    /// Adds `T^-1 e_c` times `amount` to a state: changes `xi_c` only.
    #[inline(never)]
    pub fn shift(&self, state: &mut StateVector<N>, c: usize, amount: f32) {
        if let Some(column) = self.inverse.data.0.get(c) {
            let values = components_mut(state);
            unrolled!(lane < N, { values[lane] += amount * column[lane] });
        }
    }

    /// Returns the disturbances in state space that a sample announces.
    #[inline]
    #[must_use]
    pub fn disturbance_of(&self, announced: &Announced<N>) -> StateVector<N> {
        let mut sum = zeros();
        for (c, direction) in self.directions.iter().enumerate() {
            if let Some(announced) = announced.disturbance(c) {
                self.shift(&mut sum, c, direction.model.clipped(announced));
            }
        }
        sum
    }

    /// Advances announced disturbances by a step.
    #[inline]
    pub fn move_on(&self, announced: &mut Announced<N>) {
        for (c, direction) in self.directions.iter().enumerate() {
            if announced.announces(c)
                && let Some(place) = announced.disturbances.get_mut(c)
            {
                *place = direction.model.rotated(place);
                place.bias *= self.options.bias_kept;
            }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
