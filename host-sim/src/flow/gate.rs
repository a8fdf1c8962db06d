//! The limits within which a flow observer is known to work:
//!
//! ```text
//! Gamma <= 0.6 K_c    Gamma tau <= 1    omega_b dt < sqrt(2)    K_c dt < 2
//! ```
//!
//! The first two are measured in simulations: of 133 random cases within the second, none erred by
//! more than 0.1 standard deviations; of 29 outside, ten did. The last two are the stability of the
//! discrete observer.

use std::f64::consts::SQRT_2;

use crate::number::significant;

/// Largest `Gamma / K_c`.
const SLOPE_MAX: f64 = 0.6;
/// Largest `Gamma tau`.
const DELAY_MAX: f64 = 1.0;
/// Limit of `omega_b dt`.
const BANDWIDTH_STEP: f64 = SQRT_2;
/// Limit of `K_c dt`.
const TREE_STEP: f64 = 2.0;

/// Why a flow observer cannot be designed as requested. Directions are numbered from 0 in the fields,
/// from 1 in the message.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Gate {
    /// An argument is invalid.
    #[error(transparent)]
    Wanted(BadSettings),
    /// A direction has no speed in the data.
    #[error(
        "the state does not change along direction {} in the trajectory; use a trajectory in which it does",
        .direction + 1
    )]
    Still {
        /// The direction.
        direction: usize,
    },
    /// The model's slopes are too large for the gain along the trees.
    #[error(
        "the model's slopes reach {} 1/s, more than {SLOPE_MAX} of the tree gain {} 1/s of direction \
         {}; leave the model out, measure directions closer to orthogonal, or use a smaller step",
        significant(*.lipschitz, 3), significant(*.tree_gain, 3), .direction + 1
    )]
    Slope {
        /// The direction.
        direction: usize,
        /// `Gamma`. \[1/s\]
        lipschitz: f64,
        /// `K_c`. \[1/s\]
        tree_gain: f64,
    },
    /// The model's slopes are too large for the delay of a hop.
    #[error(
        "the model's slopes of {} 1/s times the delay of a hop of {} s are {}, more than \
         {DELAY_MAX}; leave the model out, measure directions closer to orthogonal, or use a faster \
         link", significant(*.lipschitz, 3), significant(*.hop_delay, 3),
        significant(.lipschitz * .hop_delay, 3)
    )]
    Delay {
        /// `Gamma`. \[1/s\]
        lipschitz: f64,
        /// `tau`. \[s\]
        hop_delay: f64,
    },
    /// The root's filter would be unstable.
    #[error(
        "the bandwidth {} rad/s of direction {} times the step of {} s is {}, not below 1.41; lower \
         the bandwidth or use a smaller step", significant(*.bandwidth, 3), .direction + 1,
        significant(*.step, 3), significant(.bandwidth * .step, 3)
    )]
    Bandwidth {
        /// The direction.
        direction: usize,
        /// `omega_b`. \[rad/s\]
        bandwidth: f64,
        /// `dt`. \[s\]
        step: f64,
    },
    /// The coupling along the trees would be unstable.
    #[error(
        "the tree gain {} 1/s of direction {} times the step of {} s is {}, not below {TREE_STEP}; \
         lower the gain or use a smaller step", significant(*.tree_gain, 3), .direction + 1,
        significant(*.step, 3), significant(.tree_gain * .step, 3)
    )]
    TreeGain {
        /// The direction.
        direction: usize,
        /// `K_c`. \[1/s\]
        tree_gain: f64,
        /// `dt`. \[s\]
        step: f64,
    },
}

/// An invalid argument of the rules.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BadSettings {
    /// The requested error.
    #[error("the requested error is {value}, expected a finite number above 0")]
    Error {
        /// The value.
        value: f64,
    },
    /// The step.
    #[error("the step is {value} s, expected a finite number above 0")]
    Step {
        /// The value. \[s\]
        value: f64,
    },
    /// The delay of a hop.
    #[error("the delay of a hop is {value} s, expected a finite number of at least 0")]
    HopDelay {
        /// The value. \[s\]
        value: f64,
    },
    /// The number of noise levels.
    #[error("{found} noise levels for {directions} directions; give one for each")]
    NoiseLength {
        /// The number of noise levels.
        found: usize,
        /// The number of directions.
        directions: usize,
    },
    /// A noise level.
    #[error(
        "the noise of direction {} is {value}, expected a finite number of at least 0",
        .direction + 1
    )]
    Noise {
        /// The direction.
        direction: usize,
        /// The value.
        value: f64,
    },
}

/// What limits the gains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// `Gamma`; 0 without a model. \[1/s\]
    pub lipschitz: f64,
    /// `dt`. \[s\]
    pub step: f64,
}

impl Limits {
    /// Checks `omega_b` \[rad/s\] and `K_c` \[1/s\] of a direction.
    ///
    /// # Errors
    /// Returns the first limit that is exceeded.
    pub fn check_gains(
        &self,
        direction: usize,
        bandwidth: f64,
        tree_gain: f64,
    ) -> Result<(), Gate> {
        let Self { lipschitz, step } = *self;
        // What is not certain is refused, such as NaN.
        let filter_is_stable = bandwidth * step < BANDWIDTH_STEP;
        let tree_is_stable = tree_gain * step < TREE_STEP;
        let dominates = lipschitz <= SLOPE_MAX * tree_gain;
        if !filter_is_stable {
            Err(Gate::Bandwidth { direction, bandwidth, step })
        } else if !tree_is_stable {
            Err(Gate::TreeGain { direction, tree_gain, step })
        } else if !dominates {
            Err(Gate::Slope { direction, lipschitz, tree_gain })
        } else {
            Ok(())
        }
    }

    /// Checks the delay of a hop. \[s\]
    ///
    /// # Errors
    /// If the model's error would grow too much within it.
    pub fn check_delay(&self, hop_delay: f64) -> Result<(), Gate> {
        let Self { lipschitz, .. } = *self;
        if lipschitz * hop_delay <= DELAY_MAX {
            Ok(())
        } else {
            Err(Gate::Delay { lipschitz, hop_delay })
        }
    }
}
