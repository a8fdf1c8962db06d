//! What a package promises for its trial, from what was observed while its samples were collected.
//!
//! | limit | value | reason |
//! | --- | --- | --- |
//! | RMS of the innovation | [`INNOVATION_FACTOR`] times the observed one | a network that makes it larger harms the observer; the rest is for other motion of the system and for sensors with noise |
//! | broadcasts per second | [`BROADCAST_FACTOR`] times the observed rate, plus [`BROADCASTS_FREE`]; at most the rate that Theorem 2 guarantees | a rate below one a second costs nothing, and counts of few events scatter |
//!
//! A limit that no agent can exceed, one broadcast in every step, is left out. Everything else a node
//! decides by its settings.

use agent_core::package::TrialLimits;

use crate::packages::recording::Observed;

/// Largest RMS of the innovation, relative to the observed one.
pub const INNOVATION_FACTOR: f64 = 3.0;
/// Largest rate of broadcasts, relative to the observed one.
pub const BROADCAST_FACTOR: f64 = 2.0;
/// Rate of broadcasts that is always allowed. \[1/s\]
pub const BROADCASTS_FREE: f64 = 1.0;

/// Returns the limits for a package whose samples were collected under these observations, by an
/// agent with the step `step_size` \[s\] and the minimum time between broadcasts `interval_min`
/// \[s\] by Theorem 2, 0 if not known. `None` if nothing can be promised.
#[must_use]
pub fn trial_limits(
    observed: Option<&Observed>,
    interval_min: f32,
    step_size: f64,
) -> Option<TrialLimits> {
    let innovation_rms = observed
        .map(|observed| (INNOVATION_FACTOR * observed.innovation_rms) as f32)
        .filter(|&rms| rms > 0.0 && rms.is_finite());
    let guaranteed = (interval_min > 0.0).then(|| f64::from(interval_min).recip());
    let usual = observed
        .map(|observed| BROADCAST_FACTOR * observed.broadcasts_per_second + BROADCASTS_FREE);
    let rate = match (usual, guaranteed) {
        (Some(usual), Some(guaranteed)) => Some(usual.min(guaranteed)),
        (usual, guaranteed) => usual.or(guaranteed),
    };
    // In single precision, as a node has them.
    let every_step = (step_size as f32).recip();
    let broadcasts_per_second = rate.map(|rate| rate as f32).filter(|&rate| rate < every_step);
    let limits = TrialLimits { innovation_rms, broadcasts_per_second, ..TrialLimits::NONE };
    (limits != TrialLimits::NONE).then_some(limits)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limits(rms: f64, rate: f64, interval_min: f32) -> Option<(Option<f32>, Option<f32>)> {
        let observed = Observed { innovation_rms: rms, broadcasts_per_second: rate };
        trial_limits(Some(&observed), interval_min, 1e-3)
            .map(|limits| (limits.innovation_rms, limits.broadcasts_per_second))
    }

    #[test]
    fn limits_follow_from_what_was_observed() {
        assert_eq!(limits(0.5, 20.0, 0.0), Some((Some(1.5), Some(41.0))));
        // Theorem 2 guarantees at most one broadcast in 50 ms.
        assert_eq!(limits(0.5, 20.0, 0.05), Some((Some(1.5), Some(20.0))));
        assert_eq!(limits(0.5, 20.0, 0.01), Some((Some(1.5), Some(41.0))));
        // A rate that a step of 1 ms cannot exceed.
        assert_eq!(limits(0.5, 600.0, 1e-3), Some((Some(1.5), None)));
        // Nothing can stay below an RMS of zero, or below one that single precision cannot hold.
        assert_eq!(limits(0.0, 0.0, 0.0), Some((None, Some(1.0))));
        assert_eq!(limits(1e39, 600.0, 0.0), None);
        // Without observations, as in a node's recording, only Theorem 2 promises anything.
        let guaranteed = trial_limits(None, 0.05, 1e-3).unwrap();
        assert_eq!(
            (guaranteed.innovation_rms, guaranteed.broadcasts_per_second),
            (None, Some(20.0))
        );
        assert_eq!(trial_limits(None, 0.0, 1e-3), None);
        assert_eq!(trial_limits(None, 5e-4, 1e-3), None);
    }
}
