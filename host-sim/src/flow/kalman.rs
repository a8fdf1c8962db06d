//! The root's gains where a disturbance has a slow part and a harmonic: the steady Kalman gain of
//!
//! ```text
//! x' = b + p + noise q_x    b' = noise q_b      q_b = omega_b^4
//! p' =  omega q + noise q_h                     q_h = omega_h^4
//! q' = -omega p + noise q_h                     y = x + noise of density 1
//! ```
//!
//! sampled at `dt`, with the rotation of `(p, q)` exact, and divided by `dt`: the observer adds `dt
//! k nu` to each estimate. Without a harmonic, the state is `(x, b)`; then `k_o` is about `sqrt(2)
//! omega_b` and `l_b` about `omega_b^2`.
//!
//! The Riccati equation is solved by doubling (Anderson 1978), whose error squares in every pass;
//! about 20 passes of `O(4^3)` operations.

use nalgebra::{Matrix2, Matrix4, SMatrix};

/// The density, per step, that is added to each state, so that a state without noise of its own has
/// a steady gain.
const DENSITY_MIN: f64 = 1e-12;

/// Limit on the passes; a filter that settles within `2^k` steps needs k.
const PASSES_MAX: usize = 64;

/// Gains of the innovation `nu` at a root.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DisturbanceGains {
    /// `k_o`. \[1/s\]
    pub state: f64,
    /// `l_b`. \[1/s^2\]
    pub bias: f64,
    /// `l_p`; 0 without a harmonic. \[1/s^2\]
    pub cosine: f64,
    /// `l_q`; 0 without a harmonic. \[1/s^2\]
    pub sine: f64,
}

/// Computes the gains for a harmonic of `frequency` \[rad/s\], or none; the density `q_x`
/// \[1/s^2\] of noise on the state itself; the bandwidths `omega_b` and `omega_h` \[rad/s\] of the
/// slow part and of the harmonic; and the time `step` \[s\] between measurements.
///
/// # Panics
/// If an argument is negative or not finite, the step is 0, or the frequency is 0 or not below half
/// the sampling frequency, `pi / step`: the harmonic could not be told from the slow part.
#[must_use]
pub fn gains(
    frequency: Option<f64>,
    q_x: f64,
    bias_bandwidth: f64,
    harmonic_bandwidth: f64,
    step: f64,
) -> DisturbanceGains {
    let arguments = [q_x, bias_bandwidth, harmonic_bandwidth];
    let valid = arguments.iter().all(|&argument| argument >= 0.0 && argument.is_finite());
    assert!(valid && step > 0.0 && step.is_finite(), "{arguments:?}, step {step}");
    let sampled = frequency.is_none_or(|w| w > 0.0 && w * step < std::f64::consts::PI);
    assert!(sampled, "frequency {frequency:?}, step {step}");
    let [q_b, q_h] = [bias_bandwidth, harmonic_bandwidth].map(|w| (w * w) * (w * w));
    match frequency {
        None => {
            let [state, bias] = steady(&Matrix2::new(1.0, step, 0.0, 1.0), [q_x, q_b], step);
            DisturbanceGains { state, bias, cosine: 0.0, sine: 0.0 }
        }
        Some(frequency) => {
            let (c, s) = (libm::cos(frequency * step), libm::sin(frequency * step));
            let transition = Matrix4::from_row_slice(&[
                1.0, step, step, 0.0, //
                0.0, 1.0, 0.0, 0.0, //
                0.0, 0.0, c, s, //
                0.0, 0.0, -s, c,
            ]);
            let [state, bias, cosine, sine] = steady(&transition, [q_x, q_b, q_h, q_h], step);
            DisturbanceGains { state, bias, cosine, sine }
        }
    }
}

/// Returns the gain of the steady Kalman predictor whose first state is measured, divided by
/// `step`.
fn steady<const S: usize>(
    transition: &SMatrix<f64, S, S>,
    densities: [f64; S],
    step: f64,
) -> [f64; S] {
    let noise = 1.0 / step;
    let mut a = transition.transpose();
    let mut information = SMatrix::<f64, S, S>::zeros();
    information[(0, 0)] = step;
    let mut covariance = SMatrix::<f64, S, S>::zeros();
    for (state, density) in densities.into_iter().enumerate() {
        covariance[(state, state)] = density * step + DENSITY_MIN;
    }
    for _ in 0..PASSES_MAX {
        let inverse = (SMatrix::<f64, S, S>::identity() + information * covariance)
            .try_inverse()
            .expect("1 + a product of two positive semidefinite matrices is regular");
        let added = a.transpose() * covariance * inverse * a;
        let weighted = a * inverse;
        information += symmetric(&(weighted * information * a.transpose()));
        covariance += symmetric(&added);
        a = weighted * a;
        if added.amax() <= f64::EPSILON * covariance.amax() {
            break;
        }
    }
    let ahead = transition * covariance.column(0);
    let innovation = covariance[(0, 0)] + noise;
    std::array::from_fn(|state| ahead[state] / (innovation * step))
}

/// Returns `(A + A^T) / 2`.
fn symmetric<const S: usize>(a: &SMatrix<f64, S, S>) -> SMatrix<f64, S, S> {
    (a + a.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_harmonic_small_steps_give_the_continuous_gains() {
        // The Riccati equation of x' = b, b' = noise has k_o = sqrt(2) w and l_b = w^2.
        let gains = gains(None, 0.0, 50.0, 0.0, 1e-5);
        assert!((gains.state / (2f64.sqrt() * 50.0) - 1.0).abs() < 1e-3, "{gains:?}");
        assert!((gains.bias / 2500.0 - 1.0).abs() < 1e-3, "{gains:?}");
        assert_eq!((gains.cosine, gains.sine), (0.0, 0.0));
    }

    #[test]
    fn noise_on_the_state_alone_gives_its_root() {
        let gains = gains(None, 400.0, 0.0, 0.0, 1e-5);
        assert!((gains.state - 20.0).abs() < 0.01, "{gains:?}");
        assert!(gains.bias.abs() < 1e-2, "{gains:?}");
    }

    #[test]
    fn the_filter_is_stable_with_and_without_a_harmonic() {
        for frequency in [0.3, 3.8, 60.0] {
            for step in [1e-4, 1e-3, 1e-2] {
                let found = gains(Some(frequency), 0.0, 40.0, 20.0, step);
                let gain = [found.state, found.bias, found.cosine, found.sine];
                let (mut x, mut b, mut p, mut q) = (1.0, 0.0, 0.0, 0.0);
                let (c, s) = (libm::cos(frequency * step), libm::sin(frequency * step));
                for _ in 0..(10.0 / step) as usize {
                    let error = step * x;
                    (x, b, p, q) = (
                        x + step * (b + p) - gain[0] * error,
                        b - gain[1] * error,
                        c * p + s * q - gain[2] * error,
                        c * q - s * p - gain[3] * error,
                    );
                }
                assert!(x.abs() < 1e-5, "{frequency} {step}: {x}");
            }
        }
    }

    #[test]
    #[should_panic(expected = "frequency Some(0.0)")]
    fn refuses_a_harmonic_that_does_not_turn() {
        let _ = gains(Some(0.0), 0.0, 1.0, 1.0, 1e-3);
    }

    #[test]
    #[should_panic(expected = "step 0")]
    fn refuses_a_step_of_zero() {
        let _ = gains(None, 0.0, 1.0, 0.0, 0.0);
    }
}
