//! When an agent broadcasts. The paper's event trigger does when
//! `phi_1 |e_2|^2 >= phi_2 |z|^2 + epsilon / N` (equation `Trigger`),
//! with the hold error `e_2 = x_tilde - x_hat` (equation `e2i`) and the consensus term `z`.
//!
//! [`Trigger`] lists all triggers. The paper's theorems hold for the event trigger, and packages
//! carry its constants only; the others are for comparison in simulation.
//!
//! `phi_1 = k_2/2 + kappa/2 |L (x) K_1|^2` and `phi_2 = k_2 / (4 |L (x) I|^2)` need the whole
//! graph, so they are computed on the host; an agent is given the results.
//!
//! Cost: `4 N + 2` operations. No memory.

use core::num::NonZeroU32;

use crate::math::numeric::dot;
use crate::math::parameter::{ParameterError, not_negative, positive};
use crate::{StateVector, Tick};

/// When an agent broadcasts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Trigger {
    /// The paper's: when the hold error is large.
    Event(TriggerParams),
    /// At this period, in ticks, whatever the estimate does: what event triggers are compared with.
    Periodic(NonZeroU32),
}

impl Trigger {
    /// # Errors
    /// A constant that is not finite or has the wrong sign.
    pub fn validate(&self) -> Result<(), ParameterError> {
        match self {
            Self::Event(params) => params.validate(),
            Self::Periodic(_) => Ok(()),
        }
    }

    /// Whether the agent must broadcast now, `held` ticks after its last broadcast.
    #[inline]
    #[must_use]
    pub fn fires<const N: usize>(
        &self,
        held: Tick,
        hold_error: &StateVector<N>,
        consensus_term: &StateVector<N>,
    ) -> bool {
        match self {
            Self::Event(params) => params.fires(hold_error, consensus_term),
            Self::Periodic(every) => held >= Tick::from(every.get()),
        }
    }
}

/// Constants of the event trigger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TriggerParams {
    /// `phi_1`, weight of the squared hold error. Above 0. \[1/s\]
    pub hold_error_weight: f32,
    /// `phi_2`, weight of the squared consensus term. 0 or above. \[1/s\]
    pub consensus_weight: f32,
    /// `epsilon / N`, this agent's share of the error that the network may keep. Above 0,
    /// or an agent could broadcast without end. \[squared state unit/s\]
    pub threshold: f32,
}

impl TriggerParams {
    /// Checks the ranges of the constants.
    ///
    /// # Errors
    /// A constant that is not finite or has the wrong sign.
    pub fn validate(&self) -> Result<(), ParameterError> {
        positive("trigger.hold_error_weight", self.hold_error_weight)?;
        not_negative("trigger.consensus_weight", self.consensus_weight)?;
        positive("trigger.threshold", self.threshold)
    }

    /// Returns whether the agent must broadcast now.
    ///
    /// ```
    /// use agent_core::{StateVector, TriggerParams};
    ///
    /// let trigger = TriggerParams { hold_error_weight: 100.0, consensus_weight: 0.5, threshold: 1.0 };
    /// let agreement = StateVector::<1>::zeros();
    /// // Without disagreement it fires at a hold error of sqrt(1 / 100).
    /// assert!(trigger.fires(&StateVector::<1>::new(0.11), &agreement));
    /// assert!(!trigger.fires(&StateVector::<1>::new(0.09), &agreement));
    /// // Disagreement with the neighbours raises that limit.
    /// assert!(!trigger.fires(&StateVector::<1>::new(0.11), &StateVector::<1>::new(1.0)));
    /// ```
    #[inline]
    #[must_use]
    pub fn fires<const N: usize>(
        &self,
        hold_error: &StateVector<N>,
        consensus_term: &StateVector<N>,
    ) -> bool {
        self.hold_error_weight * dot(hold_error, hold_error)
            >= self.consensus_weight * dot(consensus_term, consensus_term) + self.threshold
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's constants for its network of three.
    const PAPER: TriggerParams = TriggerParams {
        hold_error_weight: 311_810.16,
        consensus_weight: 0.277_777_8,
        threshold: 1e3,
    };

    #[test]
    fn fires_at_the_radius_that_the_constants_give() {
        // |e_2| = sqrt(threshold / phi_1) = 0.0566311 with z = 0.
        let at = |length: f32| {
            PAPER.fires(&StateVector::<3>::new(0.0, length, 0.0), &StateVector::zeros())
        };
        assert!(!at(0.056_63));
        assert!(at(0.056_632));
    }

    #[test]
    fn a_large_consensus_term_delays_the_broadcast() {
        let error = StateVector::<3>::new(0.0567, 0.0, 0.0);
        assert!(PAPER.fires(&error, &StateVector::zeros()));
        assert!(!PAPER.fires(&error, &StateVector::<3>::new(10.0, 0.0, 0.0)));
    }

    #[test]
    fn a_periodic_trigger_counts_the_ticks_since_the_last_broadcast() {
        let trigger = Trigger::Periodic(NonZeroU32::new(3).unwrap());
        // Neither a large hold error nor a large consensus term matters.
        for (hold_error, consensus_term) in [(0.0, 0.0), (1e6, 0.0), (0.0, 1e6)] {
            let fires = |held| trigger.fires(held, &[hold_error].into(), &[consensus_term].into());
            assert_eq!(
                [0, 1, 2, 3, 4, Tick::MAX].map(fires),
                [false, false, false, true, true, true]
            );
        }
        assert_eq!(trigger.validate(), Ok(()));
    }

    #[test]
    fn the_event_trigger_ignores_the_time() {
        let trigger = Trigger::Event(PAPER);
        for held in [0, 1, Tick::MAX] {
            assert!(!trigger.fires(held, &StateVector::<1>::new(0.056), &StateVector::zeros()));
            assert!(trigger.fires(held, &StateVector::<1>::new(0.057), &StateVector::zeros()));
        }
        assert!(Trigger::Event(TriggerParams { threshold: 0.0, ..PAPER }).validate().is_err());
    }

    #[test]
    fn refuses_constants_that_break_the_minimum_interval() {
        assert!(PAPER.validate().is_ok());
        assert!(TriggerParams { threshold: 0.0, ..PAPER }.validate().is_err());
        assert!(TriggerParams { hold_error_weight: f32::INFINITY, ..PAPER }.validate().is_err());
        assert!(TriggerParams { consensus_weight: -1.0, ..PAPER }.validate().is_err());
    }
}
