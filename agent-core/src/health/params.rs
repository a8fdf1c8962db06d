//! Parameters and settings of health monitoring.

use core::num::NonZeroU32;

use crate::StateVector;
use crate::agent::AgentParams;
use crate::agent::region::Region;
use crate::agent::region::StateBox;
use crate::math::parameter::{ParameterError, not_negative, positive};

/// When to fall back to feedback alone, and when to return to the inner network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FallBack {
    /// Consecutive unhealthy steps before the fallback.
    pub after: NonZeroU32,
    /// Consecutive healthy steps before the return.
    pub return_after: NonZeroU32,
    /// Treat a step as unhealthy if its estimate is outside the box of trained inputs.
    pub outside_box: bool,
    /// Treat a step as unhealthy if the projection acts on the outer weights after it.
    pub projection_active: bool,
    /// Treat a step as unhealthy if it would have overflowed.
    pub diverged: bool,
}

/// User settings of health monitoring.
///
/// ```
/// use core::num::NonZeroU32;
///
/// use agent_core::HealthSettings;
/// use agent_core::health::FallBack;
///
/// let after = NonZeroU32::new(100).unwrap();
/// let settings = HealthSettings {
///     fall_back: Some(FallBack {
///         after,
///         return_after: after,
///         outside_box: true,
///         projection_active: false,
///         diverged: true,
///     }),
///     ..HealthSettings::RECOMMENDED
/// };
/// assert_eq!(settings.restart_after, NonZeroU32::new(10));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HealthSettings {
    /// When to fall back to feedback alone; `None` for never.
    pub fall_back: Option<FallBack>,
    /// Distance by which the plausible region extends beyond the box of trained inputs on each
    /// side, in widths of the box. Above 0, and larger than any excursion of the plant: an agent
    /// whose plant really is outside would restart repeatedly.
    pub plausible_margin: f32,
    /// Number of consecutive overflowing steps before a restart; outside the plausible region the
    /// agent restarts immediately. `None` disables both.
    pub restart_after: Option<NonZeroU32>,
    /// Minimum time between two reports. \[steps\]
    pub telemetry_interval: u32,
}

impl HealthSettings {
    /// Settings that do not affect a plant the network was trained for, and that stop divergence:
    /// docs/decisions/0009-restarts.md has the measurements. The fallback is disabled; reports are
    /// at least 1,000 steps apart.
    pub const RECOMMENDED: Self = Self {
        fall_back: None,
        plausible_margin: 10.0,
        restart_after: NonZeroU32::new(10),
        telemetry_interval: 1_000,
    };
}

/// Validated parameters of health monitoring. They contain copies of the package's values, because
/// the package's memory may be overwritten while the agent runs.
///
/// ```
/// use agent_core::{AgentParams, HealthParams, HealthSettings, StateBox, StateVector};
/// # use agent_core::{Neighbour, ObserverParams, OutputMatrix, OuterLawParams, ProjectionParams};
/// # use agent_core::{SymmetricMatrix, TriggerParams};
/// # let neighbours = [Neighbour { id: 2, weight: 1.0 }];
/// # let observer = ObserverParams {
/// #     output_matrix: OutputMatrix::new(&[StateVector::<2>::new(1.0, 0.0)])?,
/// #     gain: SymmetricMatrix::Scalar(50.0).unfold(),
/// #     neighbours: &neighbours,
/// # };
/// # let projection =
/// #     ProjectionParams { radius: 9.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
/// # let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection };
/// # let trigger =
/// #     TriggerParams { hold_error_weight: 1e4, consensus_weight: 0.5, threshold: 10.0 };
/// # let params = AgentParams::new(1, 1e-3, observer, outer_law, trigger)?;
///
/// let trained = StateBox { low: &[-1.0; 2], high: &[3.0; 2] };
/// let health = HealthParams::new(&params, &trained, 2.5e-3, &HealthSettings::RECOMMENDED)?;
/// assert_eq!(health.start_estimate(), StateVector::<2>::new(1.0, 1.0));
/// // 2.5 ms are two whole steps of 1 ms.
/// assert_eq!(health.interval_min(), 2);
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct HealthParams<const N: usize> {
    pub(super) trained: Region<N>,
    pub(super) plausible: Region<N>,
    /// Samples within it cannot make a step overflow: see [`AgentParams::ceiling`].
    pub(super) harmless: Region<N>,
    /// `theta_0^2`.
    pub(super) radius_squared: f32,
    /// Theorem 2's bound. \[steps\]
    pub(super) interval_min: u32,
    pub(super) fall_back: Option<FallBack>,
    pub(super) restart_after: Option<NonZeroU32>,
    pub(super) telemetry_interval: u32,
}

impl<const N: usize> HealthParams<N> {
    /// Creates the parameters for the agent `params`. `trained_box` and `broadcast_interval_min`
    /// \[s\] come from the package; an interval of 0 is not monitored.
    ///
    /// Every package that [`accept`](crate::package::accept) accepts is valid here. If the box is a
    /// single point it has no scale, and if the network is untrained its box is unbounded; in both
    /// cases the plausible region ends at [`AgentParams::ceiling`], beyond which a neighbour's sample
    /// could make a step overflow.
    ///
    /// # Errors
    /// A box that is not finite or not of dimension `N`, a setting outside its range, or a fallback
    /// with no kind of unhealthy step selected.
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
        let ceiling = agent.ceiling();
        let plausible = if trained.is_point() {
            Region::unlimited()
        } else {
            trained.widened(settings.plausible_margin)?
        }
        .with_ceiling(ceiling);
        let radius = agent.projection().radius;
        Ok(Self {
            trained,
            plausible,
            harmless: Region::cube(ceiling),
            radius_squared: radius * radius,
            // The conversion rounds down and saturates.
            interval_min: (broadcast_interval_min / agent.step_size()) as u32,
            fall_back: settings.fall_back,
            restart_after: settings.restart_after,
            telemetry_interval: settings.telemetry_interval,
        })
    }

    /// Returns the region for [`Inbox::accept_within`](crate::agent::inbox::Inbox::accept_within).
    #[must_use]
    pub fn plausible_region(&self) -> &Region<N> {
        &self.plausible
    }

    /// Returns the centre of the trained box: the initial estimate without prior knowledge of the
    /// state.
    #[must_use]
    pub fn start_estimate(&self) -> StateVector<N> {
        self.trained.centre()
    }

    /// Returns Theorem 2's bound, rounded down; 0 if it is not monitored. \[steps\]
    #[must_use]
    pub fn interval_min(&self) -> u32 {
        self.interval_min
    }
}
