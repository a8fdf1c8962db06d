//! One agent: parameters, state, and the step that combines the observer's equations.
//!
//! A step at tick `k` (time `t_k = k dt`)
//! 1. takes the frames that its neighbours broadcast at `t_k` into the held estimates,
//! 2. evaluates `Observer i` and `What_i Dot` with the measurement `y(t_k)`,
//! 3. advances estimate and outer weights to `t_(k+1)` by Euler's method,
//! 4. evaluates `Trigger` at `t_(k+1)` and, if it fires, samples the estimate there and
//!    returns the frame to broadcast.
//!
//! A frame returned by step `k` belongs to `t_(k+1)` and must reach every neighbour's inbox before
//! that neighbour's step `k + 1`. Then all ends of an edge hold the same sample over the same
//! interval, as the paper's simultaneous broadcast requires, and the result does not depend on the
//! order in which agents are stepped.
//!
//! Every step advances by one `dt`, even after ticks that a late node skipped. The alternatives are
//! worse: Euler's method over `k dt` leaves its region of stability (with the paper's gain from `k
//! = 8` on), and `k` steps with a single measurement delay a late node further. The drift of the
//! plant over the skipped ticks is lost, as with missed measurements, and the feedback corrects it
//! at its own rate. [`crate::health`] counts the skipped ticks.
//!
//! An agent whose estimate is unusable is [restarted](AgentState::restart); [`crate::health`]
//! decides when.
//!
//! Cost: the sum of the modules'. Memory: [`AgentState`] takes `4 N (FEATURES + 6) + 8 FEATURES`
//! bytes, the network's scratch, and a [`Hold`] per neighbour.
//!
//! Invariants: every number in the state is finite; an error leaves state and inbox unchanged, except that
//! the field observer has then taken over the frames.

pub mod capture;
mod error;
pub mod exchange;
#[cfg(feature = "field")]
mod field;
pub mod hold;
pub mod inbox;
mod params;
pub mod region;
mod restart;
#[cfg(feature = "authentic-frames")]
pub mod trust;

pub use error::StepError;
pub use params::AgentParams;

#[cfg(feature = "field")]
use crate::NODE_DIMENSION_MAX;
use crate::agent::capture::Sample;
use crate::agent::exchange::Exchange;
use crate::agent::hold::{Hold, HoldSlots};
use crate::agent::inbox::{Drained, Inbox};
use crate::math::numeric::{add_scaled, all_finite, components, difference, product, zeros};
use crate::math::parameter::{ParameterError, finite};
use crate::observer::features::Features;
use crate::observer::feedback::ObserverParams;
use crate::observer::network::Scratch;
use crate::observer::outer_law::OuterWeights;
use crate::wire::frame::Frame;
use crate::{StateVector, Tick};

/// Result of a step.
///
/// ```
/// use agent_core::{AgentParams, AgentState, Inbox, InnerNetwork, StateVector};
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
/// const NO_NETWORK: Option<&InnerNetwork<&[f32]>> = None;
/// let mut state = AgentState::<2, 1, _>::new(&params, StateVector::zeros(), &[0.0; 2], [None])?;
/// let output = state.step(&params, NO_NETWORK, 0, &[10.0], &mut Inbox::new([None])).unwrap();
/// // The estimate moved by 0.5, so the trigger fires. The frame is for the next tick.
/// let frame = output.broadcast.unwrap();
/// assert_eq!((frame.sender, frame.tick), (1, 1));
/// assert_eq!(frame.estimate, *state.estimate());
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepOutput<const N: usize> {
    /// The frame to broadcast, if the trigger fired.
    pub broadcast: Option<Frame<N>>,
    /// Estimate and derivative at this tick, for training and telemetry.
    pub sample: Sample<N>,
}

/// The mutable state of an agent.
///
/// `FEATURES` is the capacity for the network's features (rows of the outer weights); `S` holds one
/// slot per neighbour: an array on the node, a vector on the host.
///
/// ```
/// use agent_core::{AgentParams, AgentState, Inbox, InnerNetwork, StateVector};
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
/// const NO_NETWORK: Option<&InnerNetwork<&[f32]>> = None;
/// let mut state = AgentState::<2, 1, _>::new(&params, StateVector::zeros(), &[0.0; 2], [None])?;
/// let mut inbox = Inbox::new([None]);
///
/// let output = state.step(&params, NO_NETWORK, 0, &[1.0], &mut inbox).unwrap();
/// assert_eq!(output.sample.tick, 0);
/// assert!(state.estimate()[0] > 0.0); // moved towards the measurement
/// // Ticks must increase.
/// assert!(state.step(&params, NO_NETWORK, 0, &[1.0], &mut inbox).is_err());
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Debug)]
pub struct AgentState<const N: usize, const FEATURES: usize, S> {
    last_tick: Option<Tick>,
    estimate: StateVector<N>,
    outer_weights: OuterWeights<N, FEATURES>,
    own_hold: Hold<N>,
    neighbour_holds: S,
    /// `z_i`; changes only with a held estimate.
    consensus_term: StateVector<N>,
    consensus_is_current: bool,
    /// `e_3i` of the last step in the first `m` components.
    output_error: StateVector<N>,
    stale_frames: u32,
    exchange: Exchange<N>,
    #[cfg(feature = "field")]
    field: field::Field<N, FEATURES>,
    scratch: Scratch,
}

impl<const N: usize, const FEATURES: usize, S> AgentState<N, FEATURES, S> {
    /// Creates an uninitialised state for a `static`; call [`Self::begin`] before the first step.
    #[must_use]
    pub const fn blank(neighbour_holds: S) -> Self {
        const { assert!(N >= 1) };
        let zeros = zeros();
        Self {
            last_tick: None,
            estimate: zeros,
            outer_weights: OuterWeights::none(),
            own_hold: Hold::new(zeros, 0, 0),
            neighbour_holds,
            consensus_term: zeros,
            consensus_is_current: false,
            output_error: zeros,
            stale_frames: 0,
            exchange: Exchange::new(),
            #[cfg(feature = "field")]
            field: field::Field::none(),
            scratch: Scratch::NEW,
        }
    }
}

impl<const N: usize, const FEATURES: usize, S> AgentState<N, FEATURES, S>
where
    S: HoldSlots<N>,
{
    /// Creates an agent at tick 0 with the estimate `x_hat(0)` and the outer weights `W_hat(0)`,
    /// row by row, shape `[L, N]`. Its first sample is the initial estimate, which
    /// [`Self::announcement`] broadcasts; any contents of `neighbour_holds` are discarded.
    ///
    /// # Errors
    /// A number that is not finite, or a wrong length.
    pub fn new(
        params: &AgentParams<'_, N>,
        estimate: StateVector<N>,
        outer_weights: &[f32],
        neighbour_holds: S,
    ) -> Result<Self, ParameterError> {
        let (expected, found) = (params.neighbours().len(), neighbour_holds.as_ref().len());
        if expected != found {
            let parameter = "neighbour_holds";
            return Err(ParameterError::Length { parameter, expected, found });
        }
        let mut state = Self::blank(neighbour_holds);
        state.begin(params, estimate, outer_weights)?;
        Ok(state)
    }

    /// Initialises the state in place as [`Self::new`] does, with the slots it already has.
    ///
    /// # Errors
    /// Same as for [`Self::new`]; the state is then unchanged.
    pub fn begin(
        &mut self,
        params: &AgentParams<'_, N>,
        estimate: StateVector<N>,
        outer_weights: &[f32],
    ) -> Result<(), ParameterError> {
        self.begin_again(params, estimate, outer_weights)?;
        #[cfg(feature = "field")]
        {
            self.field = field::Field::none();
        }
        Ok(())
    }

    /// Initialises the state as [`Self::begin`] does, except that a field observer stays in use, with the same
    /// parameters.
    ///
    /// # Errors
    /// Same as for [`Self::new`]; the state is then unchanged.
    pub fn begin_again(
        &mut self,
        params: &AgentParams<'_, N>,
        estimate: StateVector<N>,
        outer_weights: &[f32],
    ) -> Result<(), ParameterError> {
        finite("initial_estimate", components(&estimate))?;
        let (expected, found) = (params.neighbours().len(), self.neighbour_holds.as_ref().len());
        if expected != found {
            let parameter = "neighbour_holds";
            return Err(ParameterError::Length { parameter, expected, found });
        }
        self.outer_weights.replace(outer_weights, &params.outer_law)?;
        self.last_tick = None;
        self.estimate = estimate;
        self.own_hold = Hold::new(estimate, 0, 0);
        self.neighbour_holds.as_mut().fill(None);
        self.consensus_term = zeros();
        self.consensus_is_current = false;
        self.output_error = zeros();
        self.stale_frames = 0;
        self.exchange = Exchange::new();
        #[cfg(feature = "field")]
        self.field.begin_again(self.outer_weights.rows());
        Ok(())
    }

    /// Returns the slots for the neighbours' samples, to be resized to the number of neighbours
    /// before [`Self::begin`].
    pub fn places(&mut self) -> &mut S {
        self.consensus_is_current = false;
        &mut self.neighbour_holds
    }

    /// Returns the agent's last sample as a frame: the broadcast at `t_0`, or a repetition for a
    /// neighbour that joined late.
    #[must_use]
    pub fn announcement(&self, params: &AgentParams<'_, N>) -> Frame<N> {
        self.own_hold.frame_from(params.id)
    }

    /// Returns the frame that tells the neighbours that this agent is about to stall, to be sent before
    /// its next step; `None` if they know already. They leave it out of their sums until they hear it
    /// again, and the next step that is taken broadcasts in any case.
    #[cfg(feature = "exchange")]
    pub fn farewell(&mut self, own: crate::AgentId) -> Option<Frame<N>> {
        if !self.exchange.leave() {
            return None;
        }
        let next = self.last_tick.map_or(0, |last| last.saturating_add(1));
        let tick = next.max(self.own_hold.tick());
        Some(Frame::farewell(own, self.own_hold.take_number(), tick))
    }

    /// Performs one step at `tick`: see the module documentation.
    ///
    /// `network` is the inner network in use; passing a different one in the next step switches to
    /// a newly trained network. With `None` the observer runs on feedback alone and the outer
    /// weights stay constant. `measurement` is `y_i(t_k)`, shape `[m]`.
    ///
    /// # Errors
    /// Input of the wrong size or not finite, or a result that would not be finite. State and inbox
    /// are then unchanged and frames stay pending.
    #[inline]
    pub fn step<F, I>(
        &mut self,
        params: &AgentParams<'_, N>,
        network: Option<&F>,
        tick: Tick,
        measurement: &[f32],
        inbox: &mut Inbox<N, I>,
    ) -> Result<StepOutput<N>, StepError>
    where
        F: Features,
        I: HoldSlots<N>,
    {
        self.attempt(params, network, tick, Some(measurement), inbox)
    }

    /// Like [`Self::step`], but continues without a measurement if there is none: the estimate then
    /// follows the network and the neighbours, `e_3` counts as 0, and the outer weights stay
    /// constant.
    ///
    /// # Errors
    /// Same as for [`Self::step`].
    #[inline]
    pub fn attempt<F, I>(
        &mut self,
        params: &AgentParams<'_, N>,
        network: Option<&F>,
        tick: Tick,
        measurement: Option<&[f32]>,
        inbox: &mut Inbox<N, I>,
    ) -> Result<StepOutput<N>, StepError>
    where
        F: Features,
        I: HoldSlots<N>,
    {
        self.check(params, network, tick, measurement, inbox)?;
        #[cfg(feature = "field")]
        if const { N <= NODE_DIMENSION_MAX } && self.field.is_in_use() {
            return self.attempt_field(params, network, tick, measurement, inbox);
        }

        let consensus_term = self.consensus_with(params, tick, inbox);
        let mut output_error = zeros();
        let innovation = match measurement {
            Some(measurement) => params.observer.output_matrix.output_error(
                &self.estimate,
                measurement,
                &mut output_error,
            ),
            None => zeros(),
        };
        let features = network
            .and_then(|network| network.features(self.estimate.as_slice(), &mut self.scratch));
        let mut derivative = product(params.gain(), &difference(&consensus_term, &innovation));
        let mut planned = None;
        if let Some(features) = features {
            add_scaled(&mut derivative, 1.0, &self.outer_weights.combine(features));
            if measurement.is_some() && network.is_some_and(Features::adapts) {
                let step = self
                    .outer_weights
                    .plan_step(&params.outer_law, params.step_size, features, &innovation)
                    .ok_or(StepError::Diverged)?;
                planned = Some(step);
            }
        }
        let mut estimate = self.estimate;
        add_scaled(&mut estimate, params.step_size, &derivative);
        if !all_finite(&estimate) {
            return Err(StepError::Diverged);
        }

        // Nothing can fail from here on.
        let sample = Sample { tick, estimate: self.estimate, derivative };
        let hold_error = difference(self.own_hold.estimate(), &estimate);
        let holds = self.neighbour_holds.as_mut();
        let drained = take_over(&self.exchange, params, inbox, holds, tick);
        self.stale_frames = drained.stale;
        self.exchange.heard(&drained);
        self.exchange.follow(&params.exchange, &derivative);
        self.last_tick = Some(tick);
        self.estimate = estimate;
        self.consensus_term = consensus_term;
        self.consensus_is_current = true;
        self.output_error = output_error;
        if let Some(planned) = &planned {
            self.outer_weights.commit(planned);
        }
        Ok(StepOutput { broadcast: self.broadcast_if_due(params, tick + 1, &hold_error), sample })
    }

    /// Samples the estimate and returns it as a frame if the trigger fires at `tick`. The hold error is that of
    /// the new estimate, passed because reading it back right after it was stored would stall.
    #[inline]
    fn broadcast_if_due(
        &mut self,
        params: &AgentParams<'_, N>,
        tick: Tick,
        hold_error: &StateVector<N>,
    ) -> Option<Frame<N>> {
        let held = self.own_hold.age(tick);
        let event = params.trigger.fires(held, hold_error, &self.consensus_term);
        // After the field observer, neighbours must not let the last sample evolve any longer.
        #[cfg(feature = "field")]
        let event = event || self.own_hold.announced().is_some();
        if !self.exchange.is_due(&params.exchange, event, tick, held) {
            return None;
        }
        self.sample_estimate(tick);
        Some(self.announcement(params))
    }

    /// Stores the estimate as the agent's next sample.
    #[inline]
    fn sample_estimate(&mut self, tick: Tick) {
        let sequence = self.own_hold.sequence().wrapping_add(1);
        self.own_hold = Hold::new(self.estimate, tick, sequence);
        self.consensus_is_current = false;
    }

    /// Computes `z_i` with the held estimates as they are after the inbox is drained at `tick`.
    #[inline]
    fn consensus_with<I>(
        &self,
        params: &AgentParams<'_, N>,
        tick: Tick,
        inbox: &Inbox<N, I>,
    ) -> StateVector<N>
    where
        I: HoldSlots<N>,
    {
        let exchange = &params.exchange;
        if self.consensus_is_current && inbox.is_empty() && !exchange.fades() {
            return self.consensus_term;
        }
        let mut term = zeros();
        let held = self.neighbour_holds.as_ref().iter().zip(inbox.pending());
        for (neighbour, (held, pending)) in params.neighbours().iter().zip(held) {
            let held = held.as_ref();
            let arriving = pending.as_ref().filter(|pending| {
                let replaces = |held| pending.replaces(held, tick, params.restart_silence);
                inbox.is_trusted() || held.is_none_or(replaces)
            });
            let moved;
            let hold = match arriving {
                // The paper's holds stay as they were sent.
                Some(sample) if !exchange.is_papers() => {
                    let step_size = params.step_size;
                    moved = self.exchange.arrived(exchange, step_size, sample, held, tick);
                    Some(&moved)
                }
                sample => sample.or(held),
            };
            let Some(hold) = hold.filter(|hold| !hold.is_absent()) else {
                continue;
            };
            let mut weight = neighbour.weight;
            if exchange.fades() {
                weight *= exchange.share(hold.age_here(tick));
            }
            ObserverParams::<N>::add_to_consensus(
                &mut term,
                weight,
                hold.estimate(),
                self.own_hold.estimate(),
            );
        }
        term
    }

    /// Checks the arguments of a step.
    #[inline]
    fn check<F, I>(
        &self,
        params: &AgentParams<'_, N>,
        network: Option<&F>,
        tick: Tick,
        measurement: Option<&[f32]>,
        inbox: &Inbox<N, I>,
    ) -> Result<(), StepError>
    where
        F: Features,
        I: HoldSlots<N>,
    {
        let last = self.last_tick;
        if tick == Tick::MAX || last.is_some_and(|last| tick <= last) {
            return Err(StepError::Tick { last, found: tick });
        }
        if let Some(measurement) = measurement {
            let (expected, found) = (params.outputs(), measurement.len());
            if expected != found {
                return Err(StepError::Outputs { expected, found });
            }
            if let Some(output) = measurement.iter().position(|value| !value.is_finite()) {
                return Err(StepError::MeasurementNotFinite { output });
            }
        }
        let expected = params.neighbours().len();
        for found in [self.neighbour_holds.as_ref().len(), inbox.pending().len()] {
            if expected != found {
                return Err(StepError::Neighbours { expected, found });
            }
        }
        if let Some(network) = network {
            let (expected, found) = (self.outer_weights.rows().len(), network.count());
            if expected != found {
                return Err(StepError::Features { expected, found });
            }
            let found = network.inputs();
            if N != found {
                return Err(StepError::NetworkInputs { expected: N, found });
            }
        }
        Ok(())
    }

    /// Replaces the outer weights, row by row, shape `[L, N]`, for a network with a
    /// different number of features.
    ///
    /// # Errors
    /// A number that is not finite, or a wrong length; the weights are then unchanged.
    pub fn replace_outer_weights(
        &mut self,
        params: &AgentParams<'_, N>,
        outer_weights: &[f32],
    ) -> Result<(), ParameterError> {
        self.outer_weights.replace(outer_weights, &params.outer_law)
    }

    /// Drops the held samples of neighbours for which `stays` returns false.
    pub(crate) fn keep_neighbours(&mut self, stays: impl Fn(usize) -> bool) {
        for (place, hold) in self.neighbour_holds.as_mut().iter_mut().enumerate() {
            if !stays(place) {
                *hold = None;
            }
        }
        // The weights of the edges may differ too.
        self.consensus_is_current = false;
    }

    /// Returns `x_hat_i` at the tick after the last step.
    #[must_use]
    pub fn estimate(&self) -> &StateVector<N> {
        &self.estimate
    }

    /// Returns `W_hat_i` at the tick after the last step.
    #[must_use]
    pub fn outer_weights(&self) -> &OuterWeights<N, FEATURES> {
        &self.outer_weights
    }

    /// Returns `z_i` of the last step.
    #[must_use]
    pub fn consensus_term(&self) -> &StateVector<N> {
        &self.consensus_term
    }

    /// Returns `e_3i` of the last step, shape `[m]`.
    #[must_use]
    pub fn output_error(&self, params: &AgentParams<'_, N>) -> &[f32] {
        &self.output_error.as_slice()[..params.outputs().min(N)]
    }

    /// Returns `K_1 (z_i - C_i^T e_3i)` of the last step, shape `[N]`, or what the field observer has in
    /// its place. \[state unit/s\]
    #[must_use]
    pub fn feedback(&self, params: &AgentParams<'_, N>) -> StateVector<N> {
        #[cfg(feature = "field")]
        if let Some(feedback) = self.field.feedback() {
            return *feedback;
        }
        let mut innovation = zeros();
        let rows = params.observer.output_matrix.rows().iter();
        for (row, &error) in rows.zip(components(&self.output_error)) {
            add_scaled(&mut innovation, error, row);
        }
        product(params.gain(), &difference(&self.consensus_term, &innovation))
    }

    /// Returns the agent's own held sample, `x_tilde_i`.
    #[must_use]
    pub fn own_hold(&self) -> &Hold<N> {
        &self.own_hold
    }

    /// Returns the neighbours' held samples, in the order of the parameters; `None` for a neighbour
    /// that has not been heard yet. One that has said farewell is [absent](Hold::is_absent).
    #[must_use]
    pub fn neighbour_holds(&self) -> &[Option<Hold<N>>] {
        self.neighbour_holds.as_ref()
    }

    /// Returns how many frames the last step dropped because the held sample was at least as new.
    #[must_use]
    pub fn stale_frames(&self) -> u32 {
        self.stale_frames
    }
}

/// Moves what has arrived in `inbox` into its senders' slots in `holds` at step `now`. Not inlined: both
/// forms of the observer call it.
#[inline(never)]
fn take_over<const N: usize, I: HoldSlots<N>>(
    exchange: &Exchange<N>,
    params: &AgentParams<'_, N>,
    inbox: &mut Inbox<N, I>,
    holds: &mut [Option<Hold<N>>],
    now: Tick,
) -> Drained {
    inbox.drain_into(holds, now, params.restart_silence, |sample, held| {
        exchange.arrived(&params.exchange, params.step_size, sample, held, now)
    })
}
