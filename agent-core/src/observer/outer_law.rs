//! The adaptation of the outer weights (equation `What_i Dot`):
//!
//! `d/dt omega = proj(mu, omega)`, `mu = -vec(Gamma sigma e_3^T C)`, `omega = vec(W_hat)`.
//!
//! Row `l` of `mu` is `-(Gamma sigma)_l (C^T e_3)^T`, and the projection subtracts a multiple of
//! `omega`, so an Euler step costs one multiply-add per weight and direction.
//!
//! In continuous time the projection keeps `|omega| <= omega_bar`. A step of finite length can
//! overshoot, considerably so after an outlier, so a step that would leave the ball is scaled back
//! radially onto its boundary. This removes the outward part that the operator would have removed,
//! and has no effect while the operator alone suffices.
//!
//! Cost: `N L` operations for `W_hat^T sigma`, `4 N L` for the update, and for `Gamma sigma` one
//! operation per feature (scalar or diagonal gain) or `L^2` (full). Memory: `4 N L` bytes.
//!
//! Invariants: `|W_hat| <= omega_bar` at all times, up to rounding; a step either replaces all
//! weights by finite numbers or changes none.

use crate::StateVector;
use crate::math::numeric::{
    add_scaled, components, components_mut, dot, for_each, square_root, unrolled, zeros,
};
use crate::math::parameter::{ParameterError, finite};
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::projection::ProjectionParams;

/// Parameters of the adaptation law.
///
/// ```
/// use agent_core::{OuterLawParams, ProjectionParams, SymmetricMatrix};
///
/// let projection =
///     ProjectionParams { radius: 9.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
/// let law = OuterLawParams { gain: SymmetricMatrix::Diagonal(&[3.0; 5]), projection };
/// assert!(law.validate(5).is_ok());
/// assert!(law.validate(4).is_err()); // the gain has one row per feature
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OuterLawParams<'a> {
    /// `Gamma`, symmetric and positive definite, shape `[L, L]`. \[1/s^2\]
    pub gain: SymmetricMatrix<'a>,
    /// The operator that keeps the weights bounded.
    pub projection: ProjectionParams,
}

impl OuterLawParams<'_> {
    /// Checks the gain and the projection.
    ///
    /// # Errors
    /// A gain of a size other than `features`, or one that is not symmetric with a positive
    /// diagonal; a projection parameter outside its range.
    pub fn validate(&self, features: usize) -> Result<(), ParameterError> {
        const GAIN: &str = "outer_law.gain";
        self.gain.validate(GAIN, features)?;
        self.gain.validate_diagonal(GAIN, features)?;
        self.projection.validate()
    }

    /// Returns the squared norm of initial weights, checking that their rows match the gain and
    /// that they are within the bound.
    pub(crate) fn validate_weights<const N: usize>(
        &self,
        rows: &[[f32; N]],
    ) -> Result<f32, ParameterError> {
        self.validate(rows.len())?;
        let norm_squared = rows.iter().fold(0.0, |sum, row| {
            let row = StateVector::from(*row);
            sum + dot(&row, &row)
        });
        let bound = self.projection.bound();
        if norm_squared <= bound * bound {
            return Ok(norm_squared);
        }
        Err(ParameterError::OutOfRange {
            parameter: "norm of outer_weights",
            value: square_root(norm_squared),
            expected: "at most projection.radius + projection.boundary_layer",
        })
    }
}

/// Returns `W^T sigma` for these rows, shape `[L]` of `[N]`, adding features in ascending order.
#[inline(always)]
#[must_use]
pub fn combine<const N: usize>(rows: &[StateVector<N>], features: &[f32]) -> StateVector<N> {
    let mut sum = zeros();
    for_each(rows.iter().zip(features), |(row, &feature)| add_scaled(&mut sum, feature, row));
    sum
}

/// `W_hat`, shape `[L, N]`, in a buffer for up to `FEATURES` rows.
#[derive(Clone, Debug)]
pub struct OuterWeights<const N: usize, const FEATURES: usize> {
    rows: heapless::Vec<StateVector<N>, FEATURES>,
    gained_features: [f32; FEATURES],
    norm_squared: f32,
}

impl<const N: usize, const FEATURES: usize> OuterWeights<N, FEATURES> {
    /// Returns weights without rows.
    pub(crate) const fn none() -> Self {
        Self { rows: heapless::Vec::new(), gained_features: [0.0; FEATURES], norm_squared: 0.0 }
    }

    /// Creates the weights from their entries in row-major order: shape `[L, N]`, `1 <= L <=
    /// FEATURES`.
    ///
    /// # Errors
    /// A length that is not a multiple of `N`, no rows or too many, an entry that is not finite, a
    /// norm above the law's bound, or a gain of a size other than `L`.
    pub fn new(entries: &[f32], law: &OuterLawParams) -> Result<Self, ParameterError> {
        let mut weights = Self::none();
        weights.replace(entries, law)?;
        Ok(weights)
    }

    /// Replaces the weights in place, as [`Self::new`] creates them.
    ///
    /// # Errors
    /// Same as for [`Self::new`]; the weights are then unchanged.
    pub(crate) fn replace(
        &mut self,
        entries: &[f32],
        law: &OuterLawParams,
    ) -> Result<(), ParameterError> {
        const PARAMETER: &str = "outer_weights";
        let length = |expected| ParameterError::Length {
            parameter: PARAMETER,
            expected,
            found: entries.len(),
        };
        let (rows, rest) = entries.as_chunks::<N>();
        if rows.is_empty() || !rest.is_empty() {
            return Err(length(rows.len().max(1) * N));
        }
        if rows.len() > FEATURES {
            return Err(length(FEATURES * N));
        }
        finite(PARAMETER, entries)?;
        let norm_squared = law.validate_weights(rows)?;
        self.rows.clear();
        for row in rows {
            // The capacity was checked above.
            let _ = self.rows.push(StateVector::from(*row));
        }
        self.norm_squared = norm_squared;
        Ok(())
    }

    /// Returns the rows, one per feature, shape `[L]` of `[N]`.
    #[must_use]
    pub fn rows(&self) -> &[StateVector<N>] {
        &self.rows
    }

    /// Returns the squared Frobenius norm.
    #[must_use]
    pub fn norm_squared(&self) -> f32 {
        self.norm_squared
    }

    /// Returns `W_hat^T sigma`, shape `[N]`, adding features in ascending order.
    #[inline(always)]
    #[must_use]
    pub fn combine(&self, features: &[f32]) -> StateVector<N> {
        combine(&self.rows, features)
    }

    /// Plans one Euler step, `W_hat + dt proj(mu, W_hat)` with `innovation = C^T e_3`, without
    /// changing the weights. `None` if a new weight would not be finite.
    #[inline]
    #[must_use]
    pub fn plan_step(
        &mut self,
        law: &OuterLawParams,
        step_size: f32,
        features: &[f32],
        innovation: &StateVector<N>,
    ) -> Option<PlannedStep<N>> {
        law.gain.apply(features, &mut self.gained_features);
        let gained = &self.gained_features;
        let correction = law.projection.correction(self.norm_squared, || {
            -self
                .rows
                .iter()
                .zip(gained)
                .fold(0.0, |sum, (row, gained)| sum + gained * dot(row, innovation))
        });
        let mut direction = *innovation;
        components_mut(&mut direction).iter_mut().for_each(|component| *component *= step_size);
        let mut planned = PlannedStep {
            direction,
            shrink: step_size * correction,
            scale: None,
            norm_squared: 0.0,
        };
        for (row, &gained) in self.rows.iter().zip(gained) {
            let (row, direction) = (components(row), components(&direction));
            let mut sum = 0.0;
            unrolled!(lane < N, {
                let weight = planned.weight(row[lane], gained, direction[lane]);
                sum += weight * weight;
            });
            planned.norm_squared += sum;
        }
        if !planned.norm_squared.is_finite() {
            return None;
        }
        let bound = law.projection.bound();
        if planned.norm_squared > bound * bound {
            planned.scale = Some(bound / square_root(planned.norm_squared));
            planned.norm_squared = bound * bound;
        }
        Some(planned)
    }

    /// Applies a step planned by [`Self::plan_step`].
    #[inline]
    pub fn commit(&mut self, planned: &PlannedStep<N>) {
        for (row, &gained) in self.rows.iter_mut().zip(&self.gained_features) {
            let (row, direction) = (components_mut(row), components(&planned.direction));
            unrolled!(lane < N, {
                row[lane] = planned.weight(row[lane], gained, direction[lane]);
            });
            if let Some(scale) = planned.scale {
                row.iter_mut().for_each(|weight| *weight *= scale);
            }
        }
        self.norm_squared = planned.norm_squared;
    }
}

/// A step of the outer weights that has been checked but not yet applied.
#[derive(Clone, Copy, Debug)]
pub struct PlannedStep<const N: usize> {
    direction: StateVector<N>,
    shrink: f32,
    /// Scales a step that would cross the bound back onto it.
    scale: Option<f32>,
    norm_squared: f32,
}

impl<const N: usize> PlannedStep<N> {
    /// Returns a weight of row `l` after the step: `w - dt (Gamma sigma)_l (C^T e_3)_j - dt c w`.
    #[inline(always)]
    fn weight(&self, weight: f32, gained: f32, direction: f32) -> f32 {
        let moved = weight + -gained * direction;
        moved + -self.shrink * weight
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PROJECTION: ProjectionParams =
        ProjectionParams { radius: 4.0, boundary_layer: 0.5, smoothing: 0.1, smoothness: 1 };

    fn vector(x: f32, y: f32) -> StateVector<2> {
        StateVector::<2>::new(x, y)
    }

    fn step(gain: SymmetricMatrix, features: &[f32], innovation: [f32; 2]) -> OuterWeights<2, 4> {
        let law = OuterLawParams { gain, projection: PROJECTION };
        let mut weights = OuterWeights::<2, 4>::new(&[1.0, 2.0, -1.0, 0.5], &law).unwrap();
        let planned =
            weights.plan_step(&law, 0.5, features, &StateVector::<2>::from(innovation)).unwrap();
        weights.commit(&planned);
        weights
    }

    #[test]
    fn one_euler_step_inside_the_ball() {
        let weights = step(SymmetricMatrix::Scalar(2.0), &[0.5, -0.25], [1.0, -2.0]);
        // W - dt * gamma * sigma * (C^T e_3)^T = W - 0.5 * 2 * [0.5; -0.25] * [1, -2]
        assert_eq!(weights.rows(), [vector(0.5, 3.0), vector(-0.75, 0.0)]);
        assert_eq!(weights.norm_squared(), 0.25 + 9.0 + 0.5625);
    }

    const LAW: OuterLawParams<'static> =
        OuterLawParams { gain: SymmetricMatrix::Scalar(2.0), projection: PROJECTION };

    #[test]
    fn the_weights_never_leave_the_bound() {
        let mut weights = OuterWeights::<2, 4>::new(&[1.0, 2.0, -1.0, 0.5], &LAW).unwrap();
        let mut largest = 0.0f32;
        for _ in 0..20_000 {
            let planned = weights
                .plan_step(&LAW, 1e-3, &[0.9, -0.4], &StateVector::<2>::new(-1.0, -2.0))
                .unwrap();
            weights.commit(&planned);
            largest = largest.max(weights.norm_squared());
        }
        assert!(largest > PROJECTION.radius * PROJECTION.radius, "the bound was never tested");
        assert!(largest <= PROJECTION.bound() * PROJECTION.bound());
    }

    #[test]
    fn an_outlier_stops_at_the_bound() {
        let bound = PROJECTION.bound();
        let mut weights = OuterWeights::<2, 4>::new(&[1.0, 2.0, -1.0, 0.5], &LAW).unwrap();
        for innovation in [1e5, -3e8, 1e12] {
            let innovation = StateVector::<2>::new(innovation, 0.3 * innovation);
            let planned = weights.plan_step(&LAW, 1e-3, &[0.9, -0.4], &innovation).unwrap();
            weights.commit(&planned);
            let norm_squared = weights.rows().iter().fold(0.0, |sum, row| sum + dot(row, row));
            assert!(norm_squared <= bound * bound * (1.0 + 4.0 * f32::EPSILON));
            assert!(
                (norm_squared - weights.norm_squared()).abs() <= 4.0 * f32::EPSILON * norm_squared
            );
        }
        // Small steps afterwards return inside.
        for _ in 0..20_000 {
            let outward = weights.rows()[0] * 1e-2;
            let planned = weights.plan_step(&LAW, 1e-3, &[1.0, 0.0], &outward).unwrap();
            weights.commit(&planned);
        }
        assert!(weights.norm_squared() < PROJECTION.radius * PROJECTION.radius);
    }

    #[test]
    fn a_step_that_overflows_changes_nothing() {
        let mut weights = OuterWeights::<2, 4>::new(&[1.0, 2.0], &LAW).unwrap();
        let huge = StateVector::<2>::new(f32::MAX, 0.0);
        assert!(weights.plan_step(&LAW, 10.0, &[1.0], &huge).is_none());
        assert_eq!(weights.rows(), [vector(1.0, 2.0)]);
        assert_eq!(weights.norm_squared(), 5.0);
    }

    #[test]
    fn refuses_weights_of_the_wrong_shape_or_size() {
        for bad in [&[][..], &[1.0; 3], &[1.0; 10], &[1.0, f32::NAN], &[4.6, 0.0], &[1e20, 0.0]] {
            assert!(OuterWeights::<2, 4>::new(bad, &LAW).is_err());
        }
        let two = OuterLawParams { gain: SymmetricMatrix::Diagonal(&[1.0, 1.0]), ..LAW };
        assert!(OuterWeights::<2, 4>::new(&[1.0; 4], &two).is_ok());
        assert!(OuterWeights::<2, 4>::new(&[1.0; 2], &two).is_err());
        let without = OuterLawParams { gain: SymmetricMatrix::Scalar(0.0), ..LAW };
        assert!(OuterWeights::<2, 4>::new(&[1.0; 4], &without).is_err());
    }
}
