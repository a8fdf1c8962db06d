//! Bounds the deviation of a correct single-precision evaluation of the equations from the exact
//! one: a running error analysis, in which every entry's bound follows from the sizes of its own
//! terms.
//!
//! With the unit roundoff `u = 2^-24`, a sum of products in which a term passes through at most `k`
//! rounded operations is off by at most `gamma_k = k u / (1 - k u)` times the sum of the terms'
//! absolute values, in whatever order it is formed. An error in one factor is multiplied by the
//! absolute value of the other. An activation multiplies it by its slope and adds its largest
//! curvature (Taylor) and [`ACTIVATION_ULP`] units in the last place. Products of two errors are
//! omitted; [`SECOND_ORDER`] compensates for them. The bounds are attained only if every rounding
//! goes in the same direction; observed errors are a small fraction of them.

use nalgebra::{DMatrix, DVector};

use super::inner_network::{curvature, slope, value as activation_value};
use super::{Network, Rates, State, Trigger, block_diagonal, vectorised};

/// The unit roundoff of single precision with rounding to nearest.
pub(crate) const UNIT: f64 = 0.5 * f32::EPSILON as f64;

/// Largest error of an activation function, in units in the last place.
const ACTIVATION_ULP: f64 = 6.0;

/// Allowance for products of two errors, which the analysis omits. They are below one part in a
/// hundred as long as the relative errors are.
const SECOND_ORDER: f64 = 1.01;

/// `gamma_k`.
fn gamma(operations: usize) -> f64 {
    let sum = operations as f64 * UNIT;
    sum / (1.0 - sum)
}

/// The largest admissible deviations, with the shapes of the values they bound.
#[derive(Clone, Debug)]
pub(crate) struct Bounds {
    /// Of `z`.
    pub(crate) consensus: DVector<f64>,
    /// Of `e_3`.
    pub(crate) output_errors: DVector<f64>,
    /// Of `d/dt x_hat`.
    pub(crate) estimates: DVector<f64>,
    /// Of `x_hat` after a step, given `x_hat` before it.
    pub(crate) next_estimates: DVector<f64>,
    /// Of the change of `omega_i` over a step, divided by its length, for each agent.
    pub(crate) outer_weights: Vec<DVector<f64>>,
}

/// The features' bounds, stacked over the agents.
fn features(network: &Network, state: &State) -> DVector<f64> {
    let mut all = Vec::new();
    for (index, agent) in network.agents.iter().enumerate() {
        let first = index * network.dimension;
        let mut value = state.estimates.rows(first, network.dimension).into_owned();
        let mut bound = DVector::zeros(network.dimension);
        for layer in &agent.inner_network.layers {
            let activation = layer.activation;
            let weights = layer.weights.abs().transpose();
            let sum = layer.affine(&value);
            let rounding = gamma(value.len() + 1) * (&weights * value.abs() + layer.biases.abs());
            let sum_bound = rounding + weights * bound;
            value = sum.map(|sum| activation_value(activation, sum));
            let carried = sum.zip_map(&sum_bound, |sum, bound| {
                slope(activation, sum).abs() * bound + 0.5 * curvature(activation) * bound.powi(2)
            });
            let own = value.map(|value| ACTIVATION_ULP * f64::from(f32::EPSILON) * value.abs());
            bound = (carried + own).add_scalar(f64::from(f32::MIN_POSITIVE));
        }
        all.extend(bound.iter());
    }
    DVector::from_vec(all)
}

impl Bounds {
    /// Computes the bounds for one step of length `step_size` \[s\].
    pub(crate) fn new(
        network: &Network,
        state: &State,
        measurement: &DVector<f64>,
        rates: &Rates,
        step_size: f64,
    ) -> Self {
        let dimension = network.dimension;
        let features = features(network, state);
        let output_matrix = network.output_matrix.abs();
        let gain = network.gain.abs();
        let outer_weights = block_diagonal(state.outer_weights.iter()).abs();

        // A difference, a product, and a sum over fewer than N neighbours.
        let consensus = gamma(network.agents.len() + 1) * network.coupling.abs() * state.held.abs();
        let output_errors =
            gamma(dimension + 1) * (&output_matrix * state.estimates.abs() + measurement.abs());
        let innovation = output_matrix.transpose()
            * (gamma(dimension) * rates.output_errors.abs() + &output_errors);
        let feedback_input = &rates.consensus - &rates.innovation;
        let feedback_bound = UNIT * feedback_input.abs() + &consensus + &innovation;
        let feedback = &gain * (gamma(dimension) * feedback_input.abs() + feedback_bound);
        let widest = state.outer_weights.iter().map(DMatrix::nrows).max().unwrap_or(0);
        let feed_forward =
            outer_weights.transpose() * (gamma(widest) * rates.features.abs() + &features);
        let estimates = feedback + feed_forward + UNIT * rates.estimates.abs();
        let next = &state.estimates + step_size * &rates.estimates;
        let next_estimates =
            step_size * (&estimates + UNIT * rates.estimates.abs()) + UNIT * next.abs();

        // |Gamma sigma e_3^T C|, with the errors of both factors.
        let gained = network.outer_gain.abs() * rates.features.abs();
        let gained_bound =
            network.outer_gain.abs() * (gamma(widest) * rates.features.abs() + &features);
        let direction_bounds =
            gained_bound * rates.innovation.abs().transpose() + &gained * innovation.transpose();
        let mut first = 0;
        let mut outer = Vec::new();
        for (index, weights) in state.outer_weights.iter().enumerate() {
            let block = direction_bounds.view((first, index * dimension), weights.shape());
            let change = weight_change(
                &network.agents[index].projection,
                &vectorised(weights),
                &rates.directions[index],
                &vectorised(&block.into_owned()),
                step_size,
            );
            outer.push(SECOND_ORDER * change);
            first += weights.nrows();
        }
        Self {
            consensus: SECOND_ORDER * consensus,
            output_errors: SECOND_ORDER * output_errors,
            estimates: SECOND_ORDER * estimates,
            next_estimates: SECOND_ORDER * next_estimates,
            outer_weights: outer,
        }
    }
}

/// The bound for one agent's `omega(t + dt) - omega(t)`, divided by `dt`, if the entries of its
/// `mu` are off by `mu_bound`.
fn weight_change(
    projection: &super::projection::Projection,
    omega: &DVector<f64>,
    mu: &DVector<f64>,
    mu_bound: &DVector<f64>,
    step_size: f64,
) -> DVector<f64> {
    let terms = omega.len();
    let outward = omega.dot(mu);
    let outward_bound = omega.abs().dot(&(gamma(terms + 2) * mu.abs() + mu_bound));
    let excess = projection.excess(omega);
    let excess_bound = gamma(terms + 2) * (omega.norm_squared() + projection.radius.powi(2));
    // The factor of omega is non-decreasing in both arguments, so its extreme values are at two
    // corners. `p` enters through m + 1 quotients with about four roundings each; eta_2 and the
    // last factors have about ten.
    let factor = 2.0 * projection.coefficient(excess, outward);
    let corner = |sign: f64| {
        2.0 * projection.coefficient(excess + sign * excess_bound, outward + sign * outward_bound)
    };
    let own = gamma(10 + 5 * (usize::from(projection.order) + 1)) * corner(1.0);
    let factor_bound = (corner(1.0) - factor).max(factor - corner(-1.0)) + own;

    // Two roundings in each product with dt, two in the sums that form the new weight.
    let moved = mu.abs() + factor * omega.abs();
    mu_bound
        + factor_bound * omega.abs()
        + gamma(2) * &moved
        + gamma(2) / step_size * (omega.abs() + step_size * moved)
}

/// The band in which the trigger's inequality is too close to an equality for single precision to
/// decide: the largest deviation of its margin, for a hold error formed by one rounded subtraction
/// and a consensus term that is off by `consensus_bound`.
pub(crate) fn trigger_band(
    trigger: &Trigger,
    hold_error: &DVector<f64>,
    consensus: &DVector<f64>,
    consensus_bound: &DVector<f64>,
) -> f64 {
    // Each square and sum, the constant rounded to single precision, its product, the sum of
    // the right side; a relative error of the vector counts twice in its square.
    let operations = gamma(hold_error.len() + 5);
    let consensus_part = operations * consensus.norm_squared()
        + 2.0 * consensus.abs().dot(consensus_bound)
        + consensus_bound.norm_squared();
    SECOND_ORDER
        * (trigger.phi_1 * operations * hold_error.norm_squared()
            + trigger.phi_2 * consensus_part
            + gamma(2) * trigger.threshold)
}
