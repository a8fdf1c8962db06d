//! The sufficiently smooth projection operator of Cai, de Queiroz and Dawson (IEEE
//! Transactions on Automatic Control 51(1), 2006), equation 4.
//!
//! With `p(theta) = theta^T theta - theta_0^2`:
//!
//! `proj(mu, theta) = mu - eta_1 eta_2 / (4 (beta^2 + 2 beta theta_0)^(m+1) theta_0^2) grad p(theta)`
//!
//! where `eta_1 = p^(m+1)` for `p > 0` and 0 elsewhere, `grad p = 2 theta`, and
//! `eta_2 = theta^T mu + sqrt((theta^T mu)^2 + delta^2)`.
//!
//! Invariants (tested as properties): the operator changes nothing inside the ball of radius
//! `theta_0`; on the sphere of radius `theta_0 + beta` it never points outwards; and it never
//! makes the Lyapunov derivative larger, `(theta* - theta)^T (proj - mu) >= 0` for every
//! `|theta*| <= theta_0`.
//!
//! The correction is always a multiple of `theta`, so only that factor is computed here.
//! Cost: one comparison inside the ball; about 40 operations in the boundary layer.

use crate::math::numeric::square_root;
use crate::math::parameter::ParameterError;

/// Parameters of the projection operator.
///
/// ```
/// use agent_core::ProjectionParams;
///
/// let params = ProjectionParams { radius: 9.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
/// assert!(params.validate().is_ok());
/// assert_eq!(params.bound(), 10.0);
///
/// // Inside the ball the operator changes nothing, and `theta^T mu` is not evaluated.
/// assert_eq!(params.correction(80.0, || unreachable!()), 0.0);
/// assert!(params.correction(90.0, || 1.0) > 0.0);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectionParams {
    /// `theta_0`, radius of the ball in which the operator is the identity. 1e-15 to 1e15, like
    /// `beta`, so that their squares neither overflow nor underflow.
    pub radius: f32,
    /// `beta`, thickness of the layer around it; in continuous time the argument stays within
    /// `theta_0 + beta`, the paper's bound `omega_bar`. 1e-15 to 1e15.
    pub boundary_layer: f32,
    /// `delta` of the operator, which smooths its corner. Above 0.
    pub smoothing: f32,
    /// `m`: the operator is this many times continuously differentiable. 0 to 7.
    pub smoothness: u8,
}

impl ProjectionParams {
    /// Checks the ranges of the parameters.
    ///
    /// # Errors
    /// A parameter outside its range.
    pub fn validate(&self) -> Result<(), ParameterError> {
        for (parameter, value) in [
            ("projection.radius", self.radius),
            ("projection.boundary_layer", self.boundary_layer),
            ("projection.smoothing", self.smoothing),
        ] {
            if !(1e-15..=1e15).contains(&value) {
                let expected = "1e-15 to 1e15";
                return Err(ParameterError::OutOfRange { parameter, value, expected });
            }
        }
        if self.smoothness > 7 {
            return Err(ParameterError::OutOfRange {
                parameter: "projection.smoothness",
                value: f32::from(self.smoothness),
                expected: "0 to 7",
            });
        }
        Ok(())
    }

    /// Returns the bound on the argument, `omega_bar = theta_0 + beta`.
    #[must_use]
    pub fn bound(&self) -> f32 {
        self.radius + self.boundary_layer
    }

    /// Returns the factor `c` in `proj(mu, theta) = mu - c theta` from `theta^T theta` and,
    /// evaluated only in the boundary layer, `theta^T mu`.
    #[inline]
    #[must_use]
    pub fn correction(&self, norm_squared: f32, outward: impl FnOnce() -> f32) -> f32 {
        let excess = norm_squared - self.radius * self.radius;
        if excess > 0.0 { self.boundary_correction(excess, outward()) } else { 0.0 }
    }

    /// Returns the factor in the boundary layer; `excess` is `p(theta)`, `outward` is `theta^T mu`.
    fn boundary_correction(&self, excess: f32, outward: f32) -> f32 {
        let depth = excess / (self.boundary_layer * (self.boundary_layer + 2.0 * self.radius));
        let mut eta_1_scaled = depth;
        for _ in 0..self.smoothness {
            eta_1_scaled *= depth;
        }
        let delta_squared = self.smoothing * self.smoothing;
        let root = square_root(outward * outward + delta_squared);
        // For negative theta^T mu the two terms of eta_2 cancel; the second form gives the same
        // number without cancellation and is never negative.
        let eta_2 = if outward < 0.0 { delta_squared / (root - outward) } else { outward + root };
        0.5 * eta_1_scaled * eta_2 / (self.radius * self.radius)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const DIMENSION: usize = 6;
    type Vector = nalgebra::SVector<f64, DIMENSION>;

    fn project(params: &ProjectionParams, mu: &Vector, theta: &Vector) -> Vector {
        let correction = params.correction(theta.dot(theta) as f32, || theta.dot(mu) as f32);
        mu - theta * f64::from(correction)
    }

    fn params() -> impl Strategy<Value = ProjectionParams> {
        (0.5f32..20.0, 0.05f32..1.0, 0.01f32..1.0, 0u8..=3).prop_map(
            |(radius, layer, smoothing, smoothness)| ProjectionParams {
                radius,
                boundary_layer: layer * radius,
                smoothing,
                smoothness,
            },
        )
    }

    fn direction() -> impl Strategy<Value = Vector> {
        prop::array::uniform6(-1.0f64..1.0)
            .prop_map(Vector::from)
            .prop_filter("a direction needs a length", |v| v.norm() > 0.1)
            .prop_map(|v| v.normalize())
    }

    proptest! {
        #[test]
        fn identity_inside_the_ball(
            params in params(), mu in direction(), theta in direction(), part in 0.0f64..0.999,
        ) {
            let theta = theta * (part * f64::from(params.radius));
            prop_assert_eq!(project(&params, &mu, &theta), mu);
        }

        #[test]
        fn never_outwards_on_the_bound(
            params in params(), mu in direction(), length in 0.0f64..1e3, theta in direction(),
        ) {
            let mu = mu * length;
            let theta = theta * f64::from(params.bound());
            let outward = theta.dot(&project(&params, &mu, &theta));
            // f32 rounding of theta^T theta and theta^T mu, relative to |theta| |mu|.
            let rounding = 1e-5 * theta.norm() * (mu.norm() + f64::from(params.smoothing));
            prop_assert!(outward <= rounding, "theta^T proj = {}", outward);
        }

        #[test]
        fn never_raises_the_lyapunov_derivative(
            params in params(), mu in direction(), length in 0.0f64..1e3,
            theta in direction(), part in 0.0f64..1.0, ideal in direction(), ideal_part in 0.0f64..1.0,
        ) {
            let mu = mu * length;
            let theta = theta * (part * f64::from(params.bound()));
            let ideal = ideal * (ideal_part * f64::from(params.radius));
            let gain = (ideal - theta).dot(&(project(&params, &mu, &theta) - mu));
            prop_assert!(gain >= 0.0, "(theta* - theta)^T (proj - mu) = {}", gain);
        }

        #[test]
        fn continuous_where_the_layer_begins(
            params in params(), mu in direction(), theta in direction(),
        ) {
            let just_outside = theta * (f64::from(params.radius) * (1.0 + 1e-6));
            let difference = (project(&params, &mu, &just_outside) - mu).norm();
            prop_assert!(difference <= 1e-3 * (1.0 + 1.0 / f64::from(params.radius)), "a jump of {}", difference);
        }
    }

    #[test]
    fn refuses_constants_out_of_range() {
        let good =
            ProjectionParams { radius: 19.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
        assert!(good.validate().is_ok());
        assert!(ProjectionParams { radius: 0.0, ..good }.validate().is_err());
        assert!(ProjectionParams { boundary_layer: -1.0, ..good }.validate().is_err());
        for extreme in [1e-16, 1e16, f32::INFINITY, f32::NAN] {
            assert!(ProjectionParams { radius: extreme, ..good }.validate().is_err());
            assert!(ProjectionParams { boundary_layer: extreme, ..good }.validate().is_err());
        }
        assert!(ProjectionParams { smoothing: f32::NAN, ..good }.validate().is_err());
        assert!(ProjectionParams { smoothness: 8, ..good }.validate().is_err());
    }
}
