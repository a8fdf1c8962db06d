//! Settings from data, for a requested error `eps` in standard deviations of the state:
//!
//! ```text
//! r = 1.5 eps / |column c of T^-1|          omega_b = 4 s sqrt(m / r), at least 2 s
//! k_o = sqrt(2) omega_b    l_b = omega_b^2  K_c = max(2 k_o, 1.7 Gamma)    |b| <= 3 max(m, 1) s
//! ```
//!
//! with `xi` and the columns in standard deviations; `omega_b <= 0.25 / dt` and `K_c <= 0.9 / dt`.
//! With sensor noise sigma, `omega_b <= (3.8 m^2 s^4 / (sigma^2 dt))^(1/5)` instead of the least
//! bandwidth, the root's error is `e = sqrt((m s^2 / omega_b^2)^2 + 1.06 sigma^2 dt omega_b)`, and
//! `r >= 3 e`.
//!
//! The constants were swept in simulations of five plants with three to six states on stars and
//! paths, then checked on 250 random cases: geometry, graph of up to 12 agents, with and without a
//! model.

use super::dense::norm;
use super::gate::{BadSettings, Gate, Limits};
use super::geometry::Geometry;
use super::statistics::Statistics;
use super::trajectory::units;

/// Radius of the trigger in requested errors.
const RADIUS: f64 = 1.5;
/// `omega_b / (s sqrt(m / r))`.
const BANDWIDTH: f64 = 4.0;
/// Least `omega_b / s` without noise.
const BANDWIDTH_MIN: f64 = 2.0;
/// Largest `omega_b dt`.
const BANDWIDTH_STEP_MAX: f64 = 0.25;
/// `omega_b^5 sigma^2 dt / (m^2 s^4)` at which noise and lag together are least.
const NOISE_OPTIMUM: f64 = 3.8;
/// `e^2 / (sigma^2 dt omega_b)` of the filter with gains `sqrt(2) omega_b` and `omega_b^2`.
const NOISE_VARIANCE: f64 = 1.06;
/// Least radius in errors of the root: a smaller one announces noise.
const RADIUS_NOISE_MIN: f64 = 3.0;
/// `K_c / k_o`.
const TREE_GAIN: f64 = 2.0;
/// Least `K_c / Gamma`: swept as 1.5, but the gate asks for `1/0.6`.
const TREE_SLOPE: f64 = 1.7;
/// Largest `K_c dt`.
const TREE_STEP_MAX: f64 = 0.9;
/// Largest estimate of a disturbance, in units of `max(m, 1) s`.
const CLIP: f64 = 3.0;
/// Least `lambda_b`. \[1/s\]
const BIAS_DECAY: f64 = 1.0;
/// Least `lambda_b / s` without a model.
const BIAS_DECAY_BLIND: f64 = 0.5;
/// Residual above which receivers extrapolate as well by the sent rate as by the model.
const MODEL_HOLD_MAX: f64 = 0.15;
/// Smallest residual that is believed: no model is known to be closer, and a gain of 0 would not
/// correct anything.
const RESIDUAL_MIN: f64 = 1e-3;

/// What the observer is to achieve, and with what.
#[derive(Clone, Debug, PartialEq)]
pub struct Wanted {
    /// `eps`, the RMS error in standard deviations of the state.
    pub error: f64,
    /// sigma, the standard deviation of the noise in each measured `xi_c`, shape `[n]`. \[unit of
    /// xi\]
    pub noise: Option<Vec<f64>>,
    /// From the trigger of an agent to the use of its frame by a neighbour. \[s\]
    pub hop_delay: f64,
    /// `dt`. \[s\]
    pub step: f64,
}

/// Settings of one direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DirectionSettings {
    /// `r_c`, the deviation from the announced value at which an agent announces again. \[unit of
    /// xi\]
    pub radius: f64,
    /// `omega_b`, the bandwidth of the root's disturbance estimate. \[rad/s\]
    pub bandwidth: f64,
    /// `k_o`. \[1/s\]
    pub root_gain: f64,
    /// `l_b`. \[1/s^2\]
    pub bias_gain: f64,
    /// `K_c`. \[1/s\]
    pub tree_gain: f64,
    /// Largest magnitude of the estimated disturbance. \[unit of xi/s\]
    pub clip: f64,
}

/// Settings of a network.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// One per direction.
    pub directions: Vec<DirectionSettings>,
    /// `lambda_b`, the decay of an announced disturbance. \[1/s\]
    pub bias_decay: f64,
    /// Whether receivers extrapolate by the model rather than by the sent rate: where the mean
    /// residual is at most 0.15, it saves a third to two thirds of the broadcasts.
    pub model_hold: bool,
    /// `e`, what the root's error is expected to be for each direction, shape `[n]`. The error of
    /// others is larger by about the radius. \[unit of xi\]
    pub expected_error: Vec<f64>,
}

impl Settings {
    /// Checks settings, also ones that were changed by hand, against the limits within which the
    /// observer is known to work.
    ///
    /// # Errors
    /// Returns the first limit that is exceeded.
    pub fn check(&self, statistics: &Statistics, wanted: &Wanted) -> Result<(), Gate> {
        let limits = Limits { lipschitz: statistics.lipschitz, step: wanted.step };
        for (c, direction) in self.directions.iter().enumerate() {
            limits.check_gains(c, direction.bandwidth, direction.tree_gain)?;
        }
        limits.check_delay(wanted.hop_delay)
    }
}

/// Derives the settings of a network.
///
/// # Errors
/// If an argument is invalid, a direction does not move in the data, or the settings would exceed a
/// limit: see [`Gate`].
///
/// # Panics
/// If the statistics have a different number of directions.
pub fn settings(
    geometry: &Geometry,
    statistics: &Statistics,
    wanted: &Wanted,
) -> Result<Settings, Gate> {
    let n = geometry.dimension();
    assert_eq!(
        statistics.speed.len(),
        n,
        "statistics and geometry must have the same state dimension"
    );
    check_arguments(n, wanted)?;
    let (unit, spread) = (units(&statistics.deviation), units(&statistics.spread));
    let mut directions = Vec::with_capacity(n);
    let mut expected_error = Vec::with_capacity(n);
    let mut speeds = 0.0;
    for c in 0..n {
        // Below, in standard deviations of xi_c.
        let s = statistics.speed[c] / spread[c];
        if !(s > 0.0 && s.is_finite()) {
            return Err(Gate::Still { direction: c });
        }
        speeds += s;
        let m = statistics.residual[c].max(RESIDUAL_MIN);
        let sigma = wanted.noise.as_ref().map_or(0.0, |noise| noise[c] / spread[c]);
        let column: Vec<f64> =
            (0..n).map(|j| geometry.inverse[(j, c)] * spread[c] / unit[j]).collect();
        let mut radius = RADIUS * wanted.error / norm(&column);
        let fast = BANDWIDTH * s * (m / radius).sqrt();
        let bandwidth = if sigma > 0.0 {
            let squared = m * m * (s * s) * (s * s) / (sigma * sigma * wanted.step);
            fast.min(libm::pow(NOISE_OPTIMUM * squared, 0.2))
        } else {
            fast.max(BANDWIDTH_MIN * s)
        }
        .min(BANDWIDTH_STEP_MAX / wanted.step);
        let lag = m * s * s / (bandwidth * bandwidth);
        let noise = NOISE_VARIANCE * sigma * sigma * wanted.step * bandwidth;
        let error = (lag * lag + noise).sqrt();
        if sigma > 0.0 {
            radius = radius.max(RADIUS_NOISE_MIN * error);
        }
        let root_gain = std::f64::consts::SQRT_2 * bandwidth;
        directions.push(DirectionSettings {
            radius: radius * spread[c],
            bandwidth,
            root_gain,
            bias_gain: bandwidth * bandwidth,
            tree_gain: (TREE_GAIN * root_gain)
                .max(TREE_SLOPE * statistics.lipschitz)
                .min(TREE_STEP_MAX / wanted.step),
            clip: CLIP * m.max(1.0) * s * spread[c],
        });
        expected_error.push(error * spread[c]);
    }
    let residual = statistics.residual.iter().sum::<f64>() / n as f64;
    let blind = BIAS_DECAY_BLIND * speeds / n as f64;
    let settings = Settings {
        directions,
        bias_decay: if statistics.has_model { BIAS_DECAY } else { blind.max(BIAS_DECAY) },
        model_hold: statistics.has_model && residual <= MODEL_HOLD_MAX,
        expected_error,
    };
    settings.check(statistics, wanted)?;
    Ok(settings)
}

fn check_arguments(n: usize, wanted: &Wanted) -> Result<(), Gate> {
    let bad = |bad| Err(Gate::Wanted(bad));
    let positive = |value: f64| value > 0.0 && value.is_finite();
    if !positive(wanted.error) {
        return bad(BadSettings::Error { value: wanted.error });
    }
    if !positive(wanted.step) {
        return bad(BadSettings::Step { value: wanted.step });
    }
    if !(wanted.hop_delay >= 0.0 && wanted.hop_delay.is_finite()) {
        return bad(BadSettings::HopDelay { value: wanted.hop_delay });
    }
    let Some(noise) = &wanted.noise else { return Ok(()) };
    if noise.len() != n {
        return bad(BadSettings::NoiseLength { found: noise.len(), directions: n });
    }
    match noise.iter().position(|&sigma| !(sigma >= 0.0 && sigma.is_finite())) {
        Some(direction) => bad(BadSettings::Noise { direction, value: noise[direction] }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::testing::{close, references, unit_outputs};
    use nalgebra::DMatrix;

    fn statistics(lipschitz: f64) -> Statistics {
        Statistics {
            mean: vec![0.0; 2],
            deviation: vec![1.0; 2],
            spread: vec![1.0; 2],
            speed: vec![2.0, 5.0],
            residual: vec![0.1, 0.2],
            lipschitz,
            has_model: true,
        }
    }

    fn geometry() -> Geometry {
        Geometry::in_state_units(&references(&unit_outputs(2, 2))).unwrap()
    }

    fn wanted() -> Wanted {
        Wanted { error: 0.014, noise: None, hop_delay: 0.01, step: 1e-3 }
    }

    fn refused(statistics: &Statistics, wanted: &Wanted) -> Gate {
        settings(&geometry(), statistics, wanted).unwrap_err()
    }

    #[test]
    fn by_hand() {
        let found = settings(&geometry(), &statistics(30.0), &wanted()).unwrap();
        // 4 s sqrt(m / 0.021), here 17.5 and 61.7 rad/s.
        let bandwidth = [8.0 * (0.1 / 0.021f64).sqrt(), 20.0 * (0.2 / 0.021f64).sqrt()];
        for (direction, omega) in found.directions.iter().zip(bandwidth) {
            close(
                &[direction.radius, direction.bandwidth, direction.root_gain, direction.bias_gain],
                &[0.021, omega, 2f64.sqrt() * omega, omega * omega],
                1e-12,
            );
        }
        let tree = [found.directions[0].tree_gain, found.directions[1].tree_gain];
        close(&tree, &[1.7 * 30.0, 2.0 * 2f64.sqrt() * bandwidth[1]], 1e-12);
        assert_eq!((found.directions[1].clip, found.bias_decay), (15.0, 1.0));
        let mut better = statistics(30.0);
        better.residual = vec![0.05, 0.2];
        assert!(settings(&geometry(), &better, &wanted()).unwrap().model_hold);
        better.has_model = false;
        let blind = settings(&geometry(), &better, &wanted()).unwrap();
        assert!(!blind.model_hold && (blind.bias_decay - 1.75).abs() < 1e-12);
    }

    #[test]
    fn settings_do_not_depend_on_the_units_of_the_state() {
        let plain = settings(&geometry(), &statistics(30.0), &wanted()).unwrap();
        // The same plant in units a thousand and a tenth as large.
        let scale = [1e3, 0.1];
        let scaled = |values: &[f64]| values.iter().zip(scale).map(|(x, s)| x * s).collect();
        let mut other = statistics(30.0);
        other.deviation = scaled(&other.deviation);
        other.spread = scaled(&other.spread);
        other.speed = scaled(&other.speed);
        let found = settings(&geometry(), &other, &wanted()).unwrap();
        for ((found, plain), scale) in found.directions.iter().zip(plain.directions).zip(scale) {
            close(&[found.bandwidth, found.tree_gain], &[plain.bandwidth, plain.tree_gain], 1e-12);
            close(&[found.radius, found.clip], &[plain.radius * scale, plain.clip * scale], 1e-12);
        }
    }

    #[test]
    fn perfect_models_and_noise_leave_gains_above_zero() {
        let mut perfect = statistics(0.0);
        perfect.residual = vec![0.0, 0.0];
        let noisy = Wanted { noise: Some(vec![0.1, 0.0]), ..wanted() };
        let found = settings(&geometry(), &perfect, &noisy).unwrap();
        assert!(found.directions.iter().all(|d| d.root_gain > 0.0 && d.tree_gain > 0.0));
        assert!(found.directions[0].radius >= 3.0 * found.expected_error[0]);
    }

    #[test]
    fn the_gate_names_the_limit_and_the_remedy() {
        let text = refused(&statistics(700.0), &wanted()).to_string();
        assert_eq!(
            text,
            "the model's slopes reach 700 1/s, more than 0.6 of the tree gain 900 1/s of direction \
             1; leave the model out, measure directions closer to orthogonal, or use a smaller step"
        );
        let slow = Wanted { hop_delay: 0.05, ..wanted() };
        let text = refused(&statistics(30.0), &slow).to_string();
        assert_eq!(
            text,
            "the model's slopes of 30.0 1/s times the delay of a hop of 0.0500 s are 1.50, more \
             than 1; leave the model out, measure directions closer to orthogonal, or use a faster \
             link"
        );
        let mut still = statistics(30.0);
        still.speed[1] = 0.0;
        assert_eq!(refused(&still, &wanted()), Gate::Still { direction: 1 });
    }

    #[test]
    fn settings_changed_by_hand_are_checked() {
        let statistics = statistics(30.0);
        let derived = settings(&geometry(), &statistics, &wanted()).unwrap();
        let check = |change: &dyn Fn(&mut DirectionSettings)| {
            let mut changed = derived.clone();
            change(&mut changed.directions[1]);
            changed.check(&statistics, &wanted())
        };
        assert_eq!(check(&|_| ()), Ok(()));
        let tree = Gate::TreeGain { direction: 1, tree_gain: 2000.0, step: 1e-3 };
        assert_eq!(check(&|d| d.tree_gain = 2000.0), Err(tree));
        let root = Gate::Bandwidth { direction: 1, bandwidth: 1500.0, step: 1e-3 };
        assert_eq!(check(&|d| d.bandwidth = 1500.0), Err(root));
        assert!(matches!(check(&|d| d.bandwidth = f64::NAN), Err(Gate::Bandwidth { .. })));
        assert!(matches!(check(&|d| d.tree_gain = 49.0), Err(Gate::Slope { .. })));
    }

    #[test]
    fn invalid_arguments_are_refused() {
        let with = |change: &dyn Fn(&mut Wanted)| {
            let mut changed = wanted();
            change(&mut changed);
            match refused(&statistics(30.0), &changed) {
                Gate::Wanted(bad) => bad,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(with(&|w| w.error = 0.0), BadSettings::Error { value: 0.0 });
        assert!(matches!(with(&|w| w.error = f64::NAN), BadSettings::Error { .. }));
        assert_eq!(with(&|w| w.step = -1.0), BadSettings::Step { value: -1.0 });
        assert_eq!(with(&|w| w.hop_delay = -1.0), BadSettings::HopDelay { value: -1.0 });
        let length = BadSettings::NoiseLength { found: 1, directions: 2 };
        assert_eq!(with(&|w| w.noise = Some(vec![0.1])), length);
        let noise = BadSettings::Noise { direction: 1, value: -0.1 };
        assert_eq!(with(&|w| w.noise = Some(vec![0.1, -0.1])), noise);
    }

    #[test]
    fn one_agent_that_measures_everything_needs_no_tree() {
        let all = DMatrix::identity(2, 2);
        let geometry = Geometry::in_state_units(&[&all]).unwrap();
        assert!(settings(&geometry, &statistics(30.0), &wanted()).is_ok());
    }
}
