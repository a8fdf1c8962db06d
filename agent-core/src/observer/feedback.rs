//! The observer (equation `Observer i`):
//!
//! `d/dt x_hat_i = W_hat_i^T sigma(Phi_hat_i(x_hat_i)) + K_1 (z_i - C_i^T e_3i)`
//! `z_i = sum_j a_ij (x_tilde_j - x_tilde_i)`, `y_hat_i = C_i x_hat_i`, `e_3i = y_hat_i - y_i`.
//!
//! The feed-forward (at present only the network's term) comes from outside; this module computes
//! the feedback: the output error, the consensus term, and their contribution to the state
//! derivative.
//!
//! Cost: `2 m N` operations for the output error and its mapping to state space, `2 N^2` for the
//! gain, and `3 N` per neighbour whenever a held estimate changes.
//!
//! Invariants: `K_1` is symmetric; neighbours are distinct and do not include the agent itself; a
//! neighbour that has not been heard yet contributes nothing.

use nalgebra::SMatrix;

use crate::math::numeric::{add_scaled, components, components_mut, difference, dot, zeros};
use crate::math::parameter::{ParameterError, finite, positive};
use crate::math::symmetric::SymmetricMatrix;
use crate::{AgentId, StateVector};

/// `C_i`, the output matrix: maps the state to the agent's measurements.
///
/// ```
/// use agent_core::{OutputMatrix, StateVector};
///
/// // Measures the second of three state components.
/// let matrix = OutputMatrix::new(&[StateVector::<3>::new(0.0, 1.0, 0.0)])?;
/// assert_eq!(matrix.outputs(), 1);
///
/// let mut error = StateVector::zeros();
/// let estimate = StateVector::<3>::new(7.0, 5.0, 8.0);
/// let innovation = matrix.output_error(&estimate, &[4.0], &mut error);
/// assert_eq!(error[0], 1.0);
/// assert_eq!(innovation, StateVector::<3>::new(0.0, 1.0, 0.0));
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct OutputMatrix<const N: usize> {
    rows: heapless::Vec<StateVector<N>, N>,
}

impl<const N: usize> OutputMatrix<N> {
    /// Creates the matrix from its rows, shape `[m, N]`, `1 <= m <= N`.
    ///
    /// # Errors
    /// A wrong number of rows, or an entry that is not finite.
    pub fn new(rows: &[StateVector<N>]) -> Result<Self, ParameterError> {
        let length =
            ParameterError::Length { parameter: "output_matrix", expected: N, found: rows.len() };
        Self::of(heapless::Vec::from_slice(rows).map_err(|_| length)?)
    }

    /// Creates the matrix from at most `N` rows.
    pub(crate) fn of(rows: heapless::Vec<StateVector<N>, N>) -> Result<Self, ParameterError> {
        if rows.is_empty() {
            let parameter = "output_matrix";
            return Err(ParameterError::Length { parameter, expected: N, found: 0 });
        }
        rows.iter().try_for_each(|row| finite("output_matrix", components(row)))?;
        Ok(Self { rows })
    }

    /// Returns `m`, the number of outputs.
    #[must_use]
    pub fn outputs(&self) -> usize {
        self.rows.len()
    }

    /// Returns the rows, one per output.
    #[must_use]
    pub fn rows(&self) -> &[StateVector<N>] {
        &self.rows
    }

    /// Writes `e_3 = C x_hat - y`, shape `[m]`, to `error` and returns `C^T e_3`, shape `[N]`,
    /// which drives both the observer and the outer weights.
    #[inline]
    #[must_use]
    pub fn output_error(
        &self,
        estimate: &StateVector<N>,
        measurement: &[f32],
        error: &mut StateVector<N>,
    ) -> StateVector<N> {
        let mut innovation = zeros();
        let errors = components_mut(error);
        for ((row, &measured), error) in self.rows.iter().zip(measurement).zip(errors) {
            *error = dot(row, estimate) - measured;
            add_scaled(&mut innovation, *error, row);
        }
        innovation
    }
}

/// One edge of the communication graph, as seen from one end.
///
/// ```
/// use agent_core::Neighbour;
///
/// let neighbour = Neighbour { id: 2, weight: 0.5 };
/// assert!(neighbour.weight > 0.0);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// The agent at the other end.
    pub id: AgentId,
    /// `a_ij`, weight of the edge. Above 0.
    pub weight: f32,
}

/// Parameters of the feedback.
///
/// ```
/// use agent_core::{Neighbour, ObserverParams, OutputMatrix, StateVector, SymmetricMatrix};
///
/// let params = ObserverParams {
///     output_matrix: OutputMatrix::new(&[StateVector::<2>::new(1.0, 0.0)])?,
///     gain: SymmetricMatrix::Scalar(50.0).unfold(),
///     neighbours: &[Neighbour { id: 2, weight: 0.5 }, Neighbour { id: 3, weight: 1.0 }],
/// };
/// assert!(params.validate(1).is_ok());
/// assert!(params.validate(2).is_err()); // an agent is not its own neighbour
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct ObserverParams<'a, const N: usize> {
    /// `C_i`, shape `[m, N]`.
    pub output_matrix: OutputMatrix<N>,
    /// `K_1`, symmetric, shape `[N, N]`. \[1/s\]
    pub gain: SMatrix<f32, N, N>,
    /// The neighbours and their edge weights, in summation order.
    pub neighbours: &'a [Neighbour],
}

impl<const N: usize> ObserverParams<'_, N> {
    /// Checks the gain and the neighbours of agent `own`.
    ///
    /// # Errors
    /// A gain that is not finite or not symmetric, a neighbour that is repeated or is `own`, or a
    /// weight that is not above 0.
    pub fn validate(&self, own: AgentId) -> Result<(), ParameterError> {
        SymmetricMatrix::Full(self.gain.data.0.as_flattened()).validate("observer.gain", N)?;
        for (index, neighbour) in self.neighbours.iter().enumerate() {
            let id = neighbour.id;
            if id == own {
                return Err(ParameterError::OwnNeighbour { id });
            }
            if self.neighbours.iter().take(index).any(|earlier| earlier.id == id) {
                return Err(ParameterError::RepeatedNeighbour { id });
            }
            positive("observer.neighbours.weight", neighbour.weight)?;
        }
        Ok(())
    }

    /// Adds one neighbour's `a_ij (x_tilde_j - x_tilde_i)` to the consensus term.
    #[inline]
    pub(crate) fn add_to_consensus(
        term: &mut StateVector<N>,
        weight: f32,
        held: &StateVector<N>,
        own: &StateVector<N>,
    ) {
        add_scaled(term, weight, &difference(held, own));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn params(neighbours: &[Neighbour]) -> ObserverParams<'_, 2> {
        ObserverParams {
            output_matrix: OutputMatrix::new(&[StateVector::<2>::new(1.0, 2.0)]).unwrap(),
            gain: SMatrix::<f32, 2, 2>::new(3.0, 1.0, 1.0, 4.0),
            neighbours,
        }
    }

    #[test]
    fn output_error_and_innovation_follow_their_definitions() {
        let mut error = StateVector::zeros();
        let innovation = params(&[]).output_matrix.output_error(
            &StateVector::<2>::new(3.0, 4.0),
            &[10.0],
            &mut error,
        );
        assert_eq!(error[0], 1.0); // 1*3 + 2*4 - 10
        assert_eq!(innovation, StateVector::<2>::new(1.0, 2.0));
    }

    #[test]
    fn the_consensus_term_is_a_sum_of_weighted_differences() {
        let (own, mut term) = (StateVector::<2>::new(1.0, 1.0), StateVector::zeros());
        for (weight, held) in [(2.0, [2.0, 3.0]), (0.5, [-1.0, 1.0])] {
            ObserverParams::<2>::add_to_consensus(&mut term, weight, &held.into(), &own);
        }
        assert_eq!(term, StateVector::<2>::new(2.0 - 1.0, 4.0));
    }

    #[test]
    fn refuses_what_the_analysis_excludes() {
        assert!(params(&[]).validate(0).is_ok());
        let mut skew = params(&[]);
        skew.gain[(0, 1)] = 2.0;
        assert_eq!(
            skew.validate(0),
            Err(ParameterError::NotSymmetric { parameter: "observer.gain", row: 1, column: 0 })
        );
        let own = [Neighbour { id: 3, weight: 1.0 }];
        assert_eq!(params(&own).validate(3), Err(ParameterError::OwnNeighbour { id: 3 }));
        let twice = [Neighbour { id: 3, weight: 1.0 }; 2];
        assert_eq!(params(&twice).validate(0), Err(ParameterError::RepeatedNeighbour { id: 3 }));
        let weightless = [Neighbour { id: 3, weight: 0.0 }];
        assert!(params(&weightless).validate(0).is_err());
        assert!(OutputMatrix::<2>::new(&[]).is_err());
        assert!(OutputMatrix::<2>::new(&[StateVector::<2>::zeros(); 3]).is_err());
        assert!(OutputMatrix::<2>::new(&[StateVector::<2>::new(f32::NAN, 0.0)]).is_err());
    }
}
