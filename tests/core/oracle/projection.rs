//! The projection operator on vectors: equation 4 of Cai, de Queiroz and Dawson, "A
//! sufficiently smooth projection operator" (IEEE Transactions on Automatic Control, 2006),
//! which `What_i Dot` refers to.

use nalgebra::DVector;

/// The constants of the operator, with the names of its paper.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projection {
    /// `theta_0`.
    pub(crate) radius: f64,
    /// `beta`.
    pub(crate) layer: f64,
    /// `delta`.
    pub(crate) smoothing: f64,
    /// `m`.
    pub(crate) order: u8,
}

impl Projection {
    /// `p(theta) = theta^T theta - theta_0^2`.
    pub(crate) fn excess(&self, theta: &DVector<f64>) -> f64 {
        theta.dot(theta) - self.radius.powi(2)
    }

    /// `eta_1 eta_2 / (4 (beta^2 + 2 beta theta_0)^(m+1) theta_0^2)` from `p` and
    /// `1/2 grad p^T mu`; not decreasing in either.
    pub(crate) fn coefficient(&self, excess: f64, outward: f64) -> f64 {
        let power = i32::from(self.order) + 1;
        let eta_1 = if excess > 0.0 { excess.powi(power) } else { 0.0 };
        let eta_2 = outward + outward.hypot(self.smoothing);
        let full = (self.layer.powi(2) + 2.0 * self.layer * self.radius).powi(power);
        eta_1 * eta_2 / (4.0 * full * self.radius.powi(2))
    }

    /// `proj(mu, theta)`.
    pub(crate) fn apply(&self, mu: &DVector<f64>, theta: &DVector<f64>) -> DVector<f64> {
        let gradient = 2.0 * theta;
        let outward = 0.5 * gradient.dot(mu);
        mu - self.coefficient(self.excess(theta), outward) * gradient
    }
}

#[test]
fn on_the_outer_sphere_nothing_points_outwards() {
    let projection = Projection { radius: 3.0, layer: 0.5, smoothing: 0.1, order: 1 };
    for angle in (0..360).map(|degree| f64::from(degree).to_radians()) {
        let mu = DVector::from_vec(vec![4.0 * angle.cos(), 4.0 * angle.sin()]);
        let (inside, sphere) =
            (DVector::from_vec(vec![2.9, 0.0]), DVector::from_vec(vec![3.5, 0.0]));
        assert_eq!(projection.apply(&mu, &inside), mu);
        let outward = sphere.dot(&projection.apply(&mu, &sphere));
        assert!(outward <= 0.0, "{outward} at {angle}");
    }
}
