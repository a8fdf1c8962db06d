//! What does not change about the watch over an agent.

use core::num::NonZeroU32;

use crate::StateVector;
use crate::agent::AgentParams;
use crate::agent::region::Region;
use crate::agent::region::StateBox;
use crate::math::parameter::{ParameterError, not_negative, positive};

/// When the inner network is left out, and when it is used again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FallBack {
    /// Unhealthy steps in a row until the network is left out.
    pub after: NonZeroU32,
    /// Healthy steps in a row until it is used again.
    pub return_after: NonZeroU32,
    /// Whether a step is unhealthy that leads outside the box of trained inputs.
    pub outside_box: bool,
    /// Whether a step is unhealthy after which the projection acts on the outer weights.
    pub projection_active: bool,
    /// Whether a step is unhealthy that would have overflowed.
    pub diverged: bool,
}

/// What the user of an agent chooses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HealthSettings {
    /// When to leave the inner network out; `None` for never.
    pub fall_back: Option<FallBack>,
    /// How far the plausible region reaches beyond the box of trained inputs on either side, in
    /// widths of the box. Above 0. Larger than any excursion of the plant: an agent whose plant
    /// really is outside would begin anew again and again.
    pub plausible_margin: f32,
    /// After how many steps in a row that overflow the agent begins anew; outside the plausible
    /// region it does so at once. `None` for never, in either case.
    pub restart_after: Option<NonZeroU32>,
    /// Least time between two reports. \[steps\]
    pub telemetry_interval: u32,
}

impl HealthSettings {
    /// What does no harm to a plant that its network was trained for, and ends what no plant does:
    /// docs/decisions/0009-restarts.md has the measurements. The network is never left out;
    /// reports come at most every 1,000 steps.
    pub const RECOMMENDED: Self = Self {
        fall_back: None,
        plausible_margin: 10.0,
        restart_after: NonZeroU32::new(10),
        telemetry_interval: 1_000,
    };
}

/// Everything about the watch that does not change, checked as a whole. It owns what it needs of
/// the package, whose memory may be written to while the agent runs.
#[derive(Clone, Debug, PartialEq)]
pub struct HealthParams<const N: usize> {
    pub(super) trained: Region<N>,
    pub(super) plausible: Region<N>,
    /// `theta_0^2`.
    pub(super) radius_squared: f32,
    /// Theorem 2's bound. \[steps\]
    pub(super) interval_min: u32,
    pub(super) fall_back: Option<FallBack>,
    pub(super) restart_after: Option<NonZeroU32>,
    pub(super) telemetry_interval: u32,
}

impl<const N: usize> HealthParams<N> {
    /// The watch over the agent with these parameters. `trained_box` and
    /// `broadcast_interval_min` \[s\] are the package's; an interval of 0 is not watched.
    ///
    /// Whatever [`accept`](crate::package::accept) takes is taken here. The plausible region of a box
    /// that is a single point has no limits, because nothing says how far from it is far; that of a
    /// box without limits, which is what a network has that was not trained, has none either.
    ///
    /// # Errors
    /// A box that is not finite or not of the dimension `N`; a setting that is out of its range; a
    /// fall-back for no reason.
    pub fn new(
        agent: &AgentParams<'_, N>,
        trained_box: &StateBox<'_>,
        broadcast_interval_min: f32,
        settings: &HealthSettings,
    ) -> Result<Self, ParameterError> {
        not_negative("broadcast_interval_min", broadcast_interval_min)?;
        positive("health.plausible_margin", settings.plausible_margin)?;
        if settings.fall_back.is_some_and(|f| !f.outside_box && !f.projection_active && !f.diverged)
        {
            return Err(ParameterError::OutOfRange {
                parameter: "kinds of unhealthy steps in health.fall_back",
                value: 0.0,
                expected: "at least one, or no fall_back",
            });
        }
        let trained = Region::copied(trained_box)?;
        let plausible = if trained.is_point() {
            Region::unlimited()
        } else {
            trained.widened(settings.plausible_margin)?
        };
        let radius = agent.projection().radius;
        Ok(Self {
            trained,
            plausible,
            radius_squared: radius * radius,
            // The conversion rounds down and saturates.
            interval_min: (broadcast_interval_min / agent.step_size()) as u32,
            fall_back: settings.fall_back,
            restart_after: settings.restart_after,
            telemetry_interval: settings.telemetry_interval,
        })
    }

    /// Where estimates are believed: for [`Inbox::accept_within`](crate::agent::inbox::Inbox::accept_within).
    #[must_use]
    pub fn plausible_region(&self) -> &Region<N> {
        &self.plausible
    }

    /// The centre of the trained box: where an agent begins that knows nothing of the state.
    #[must_use]
    pub fn start_estimate(&self) -> StateVector<N> {
        self.trained.centre()
    }

    /// Theorem 2's bound, rounded down; 0 if it is not watched. \[steps\]
    #[must_use]
    pub fn interval_min(&self) -> u32 {
        self.interval_min
    }
}
