//! An agent outside a run, for programs that bring their own plant and network: from a package to steps,
//! for any state dimension.
//!
//! It is what a node is without its board: the same parameters from the same package, the same
//! [`WatchedAgent`] for every step, and therefore the same bits as a node and as the agents of a run.
//!
//! Cost: that of the core's step and one copy of the agent's parameters. A step allocates nothing.

use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::health::{
    Health, HealthCounters, HealthParams, HealthSettings, WatchedAgent, WatchedStep,
};
use agent_core::math::parameter::ParameterError;
use agent_core::observer::network::{LAYER_WIDTH_MAX, Scratch};
use agent_core::package::{
    Capacity, NetworkPlace, Package, PackageError, ParamsPlace, Refusal, Requirements, accept,
};
use agent_core::wire::frame::{FrameBytes, FrameError};
use agent_core::{AgentId, StateVector, Tick};

use crate::error::{ErrorCode, Reported};
use crate::packages::refusal::{hint, kind};
use crate::packages::{PackageBytes, with_dimension};

/// Settings of a health monitor that only counts: every neighbour is believed, and the agent never restarts, as in
/// a scenario without `[health]`.
pub const COUNTING: HealthSettings = HealthSettings {
    fall_back: None,
    plausible_margin: 1e15,
    restart_after: None,
    telemetry_interval: HealthSettings::RECOMMENDED.telemetry_interval,
};

/// What an agent outside a run requires of its package: it has no known inputs.
const REQUIREMENTS: Requirements<'static> = Requirements {
    capacity: Capacity { known_inputs: 0, ..Capacity::UNLIMITED },
    ..Requirements::ANY
};

/// Largest number of neighbours of an agent outside a run.
pub const NEIGHBOURS_MAX: usize = 1024;

type Holds<const N: usize> = Vec<Option<Hold<N>>>;

/// Why an agent cannot be created.
#[derive(Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum AgentError {
    /// A node would refuse the package.
    #[error("the package: a node would refuse it: {refusal}; {}", hint(kind(refusal)))]
    Refused {
        /// Its reason.
        refusal: Refusal,
    },
    /// The package has more neighbours than [`NEIGHBOURS_MAX`], or a parameter of its own is invalid.
    #[error("the package: {0}; train a package for an agent that it fits")]
    Parameter(ParameterError),
    /// The initial estimate's dimension differs from the package's.
    #[error(
        "the initial estimate has {found} components; give the {expected} of the package's agent"
    )]
    Dimension {
        /// Components that the agent has.
        expected: usize,
        /// Components given.
        found: usize,
    },
    /// The initial estimate is not finite.
    #[error("the initial estimate is not finite; give finite numbers")]
    NotFinite,
}

impl Reported for AgentError {
    fn code(&self) -> ErrorCode {
        match self {
            Self::Refused { .. } | Self::Parameter(_) => ErrorCode::PackageRefused,
            Self::Dimension { .. } | Self::NotFinite => ErrorCode::Usage,
        }
    }
}

impl Reported for FrameError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Frame
    }
}

impl Reported for StepError {
    fn code(&self) -> ErrorCode {
        ErrorCode::Run
    }
}

/// An agent that the caller steps.
///
/// ```
/// use agent_core::health::HealthSettings;
/// use host_sim::agent::Agent;
/// use host_sim::engine::start_package;
/// use host_sim::scenario::{PAPER, Scenario};
///
/// let scenario = Scenario::parse("paper", PAPER)?;
/// let package = start_package(&scenario, 0, 0)?.expect("the paper has a network");
/// let mut agent = Agent::new(&package, None, &HealthSettings::RECOMMENDED)?;
/// let first = agent.announcement(); // to its neighbours
/// let frame = agent.step(0, Some(&[1.0]))?;
/// assert_eq!((agent.id(), agent.estimate().len()), (1, 3));
/// # let _ = (first, frame);
/// # Ok::<(), Box<dyn core::error::Error>>(())
/// ```
pub struct Agent(Box<dyn AnyDimension + Send + Sync>);

impl Agent {
    /// Creates the agent of `package`, which is checked as a node checks it. `estimate` is `x_hat(0)`, shape
    /// `[n]`; without it, the agent begins where a node does, in the middle of the trained box.
    ///
    /// # Errors
    /// See [`AgentError`].
    pub fn new(
        package: &PackageBytes,
        estimate: Option<&[f32]>,
        health: &HealthSettings,
    ) -> Result<Self, AgentError> {
        // The last arm is unreachable: `Architecture` bounds the number of inputs.
        with_dimension!(
            package.package().dimension(),
            fixed(package, estimate, health),
            else Err(AgentError::Refused { refusal: Refusal::Package(PackageError::Malformed) })
        )
        .map(Self)
    }

    /// Returns its number.
    #[must_use]
    pub fn id(&self) -> AgentId {
        self.0.package().package().node.agent
    }

    /// Returns its package.
    #[must_use]
    pub fn package(&self) -> &PackageBytes {
        self.0.package()
    }

    /// Keeps a received frame for the next step.
    ///
    /// # Errors
    /// See [`WatchedAgent::receive`]; the refusal is counted.
    #[inline]
    pub fn receive(&mut self, frame: &[u8]) -> Result<(), FrameError> {
        self.0.receive(frame)
    }

    /// Takes the step at `tick` with `measurement`, shape `[m]`; `None` goes on from the neighbours alone.
    /// Returns the frame to broadcast, if any. After an estimate has become unusable, the agent restarts and
    /// broadcasts where it restarts.
    ///
    /// # Errors
    /// If the step is refused; state and pending frames are then unchanged.
    #[inline]
    pub fn step(
        &mut self,
        tick: Tick,
        measurement: Option<&[f32]>,
    ) -> Result<Option<FrameBytes>, StepError> {
        self.0.step(tick, measurement)
    }

    /// Returns the frame with its last broadcast sample: before the first step, what a node sends when it starts.
    #[must_use]
    pub fn announcement(&self) -> FrameBytes {
        self.0.announcement()
    }

    /// Returns `x_hat`, shape `[n]`.
    #[inline]
    #[must_use]
    pub fn estimate(&self) -> &[f32] {
        self.0.estimate()
    }

    /// Returns `d/dt x_hat` of the last step, shape `[n]`; `None` before the first and after one that was
    /// refused or ended in a restart. \[state unit/s\]
    #[must_use]
    pub fn derivative(&self) -> Option<&[f32]> {
        self.0.derivative()
    }

    /// Returns `W_hat`, row-major, shape `[L, n]`.
    #[must_use]
    pub fn outer_weights(&self) -> &[f32] {
        self.0.outer_weights()
    }

    /// Returns its health counters.
    #[must_use]
    pub fn health(&self) -> &HealthCounters {
        self.0.health().counters()
    }

    /// Whether it uses its network, which it does unless it has fallen back to feedback alone.
    #[must_use]
    pub fn network_in_use(&self) -> bool {
        self.0.health().network_in_use()
    }
}

impl std::fmt::Debug for Agent {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Agent").field(self.package()).finish()
    }
}

/// What an agent of any state dimension does.
trait AnyDimension {
    fn package(&self) -> &PackageBytes;
    fn receive(&mut self, frame: &[u8]) -> Result<(), FrameError>;
    fn step(
        &mut self,
        tick: Tick,
        measurement: Option<&[f32]>,
    ) -> Result<Option<FrameBytes>, StepError>;
    fn announcement(&self) -> FrameBytes;
    fn estimate(&self) -> &[f32];
    fn derivative(&self) -> Option<&[f32]>;
    fn outer_weights(&self) -> &[f32];
    fn health(&self) -> &Health;
}

/// An agent with `N` state components, laid out as in a node's memory.
struct Fixed<const N: usize> {
    bytes: PackageBytes,
    params: ParamsPlace<N, NEIGHBOURS_MAX>,
    network: NetworkPlace,
    state: AgentState<N, LAYER_WIDTH_MAX, Holds<N>>,
    inbox: Inbox<N, Holds<N>>,
    health_params: HealthParams<N>,
    health: Health,
    derivative: Option<StateVector<N>>,
}

fn fixed<const N: usize>(
    package: &PackageBytes,
    estimate: Option<&[f32]>,
    health: &HealthSettings,
) -> Result<Box<dyn AnyDimension + Send + Sync>, AgentError> {
    let bytes = package.clone();
    let accepted = accept::<N>(bytes.as_bytes(), &REQUIREMENTS, &mut Scratch::NEW.clone());
    let package = accepted.map_err(|refusal| AgentError::Refused { refusal })?;
    let place = ParamsPlace::<N, NEIGHBOURS_MAX>::new(&package, bytes.as_bytes())
        .map_err(AgentError::Parameter)?;
    let malformed = || AgentError::Refused { refusal: Refusal::Package(PackageError::Malformed) };
    let network = NetworkPlace::new(&package, bytes.as_bytes()).ok_or_else(malformed)?;
    let params: AgentParams<'_, N> = place.params(bytes.as_bytes()).ok_or_else(malformed)?;
    let (health_params, state) = started(&params, &package, estimate, health)?;
    let inbox = Inbox::new(vec![None; params.neighbours().len()]);
    Ok(Box::new(Fixed {
        params: place,
        network,
        state,
        inbox,
        health_params,
        health: Health::new(),
        derivative: None,
        bytes,
    }))
}

type Started<const N: usize> = (HealthParams<N>, AgentState<N, LAYER_WIDTH_MAX, Holds<N>>);

/// Returns an agent's state after its start.
fn started<const N: usize>(
    params: &AgentParams<'_, N>,
    package: &Package<'_>,
    estimate: Option<&[f32]>,
    health: &HealthSettings,
) -> Result<Started<N>, AgentError> {
    let health_params = HealthParams::new(
        params,
        &package.trained_states(),
        package.broadcast_interval_min,
        health,
    )
    .map_err(AgentError::Parameter)?;
    let estimate = match estimate {
        None => health_params.start_estimate(),
        Some(given) => {
            let given: &[f32; N] = given
                .try_into()
                .map_err(|_| AgentError::Dimension { expected: N, found: given.len() })?;
            if !given.iter().all(|x| x.is_finite()) {
                return Err(AgentError::NotFinite);
            }
            StateVector::from(*given)
        }
    };
    let places = vec![None; params.neighbours().len()];
    let mut state = AgentState::new(params, estimate, package.outer_weights, places)
        .map_err(AgentError::Parameter)?;
    state.set_field(params, package.node.field).map_err(AgentError::Parameter)?;
    Ok((health_params, state))
}

impl<const N: usize> Fixed<N> {
    fn params(&self) -> AgentParams<'_, N> {
        self.params.params(self.bytes.as_bytes()).expect("the package's own bytes")
    }
}

impl<const N: usize> AnyDimension for Fixed<N> {
    fn package(&self) -> &PackageBytes {
        &self.bytes
    }

    fn receive(&mut self, frame: &[u8]) -> Result<(), FrameError> {
        let Self { bytes, params, state, inbox, health_params, health, .. } = self;
        let params = params.params(bytes.as_bytes()).expect("the package's own bytes");
        WatchedAgent { params: &params, health_params, state, inbox, health }.receive(frame)
    }

    fn step(
        &mut self,
        tick: Tick,
        measurement: Option<&[f32]>,
    ) -> Result<Option<FrameBytes>, StepError> {
        let Self { bytes, params, network, state, inbox, health_params, health, derivative } = self;
        let bytes = bytes.as_bytes();
        let params = params.params(bytes).expect("the package's own bytes");
        let outer_weights = network.outer_weights(bytes).expect("the package's own bytes");
        let network = network.network(bytes);
        let mut watched = WatchedAgent { params: &params, health_params, state, inbox, health };
        let step = watched.attempt(network.as_ref(), outer_weights, tick, measurement);
        *derivative = step.sample().map(|sample| sample.derivative);
        match step {
            WatchedStep::Refused(error) => Err(error),
            step => Ok(step.broadcast().map(|frame| frame.encode())),
        }
    }

    fn announcement(&self) -> FrameBytes {
        self.state.announcement(&self.params()).encode()
    }

    fn estimate(&self) -> &[f32] {
        self.state.estimate().as_slice()
    }

    fn derivative(&self) -> Option<&[f32]> {
        self.derivative.as_ref().map(|derivative| derivative.as_slice())
    }

    fn outer_weights(&self) -> &[f32] {
        agent_core::service::numbers(self.state.outer_weights().rows())
    }

    fn health(&self) -> &Health {
        &self.health
    }
}
