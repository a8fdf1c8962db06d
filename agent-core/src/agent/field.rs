//! The step of an agent that runs the [field observer](crate::observer::field).
//!
//! It has the order of the paper's step: frames of `t_k` are taken over, estimate, disturbances and
//! samples advance to `t_(k+1)`, and a broadcast is due if a direction in which neighbours follow the
//! agent has moved away from its sample by the radius. A relay announces what it holds of its parent,
//! so that errors do not add up along a path; it sees the parent's sample one step later.
//!
//! An agent that repeats its events over links that fail also repeats what a neighbour turns out not to
//! have received ([`echo`]).
//!
//! All ends of an edge extrapolate a sample by the same operations, so they hold the same bits as long as
//! no frame is lost or late. Where the predictions of two agents differ, by their digests, the sender
//! announces rates instead.
//!
//! An agent announces itself once when its parameters or its network change.
//!
//! Memory: [`FieldParams`], 16 bytes for each direction and `4 N FEATURES` for outer weights. Cost:
//! that of the paper's step, and with a model hold one evaluation of the network for each held sample.

mod echo;

use crate::StateVector;
use crate::Tick;
use crate::agent::capture::Sample;
use crate::agent::exchange::Exchange;
use crate::agent::hold::{Hold, HoldSlots, LAG_MAX};
use crate::agent::inbox::Inbox;
use crate::agent::{AgentParams, AgentState, StepError, StepOutput, take_over};
use crate::math::numeric::{
    add_scaled, all_finite, components, components_mut, difference, for_each, zeros,
};
use crate::math::parameter::ParameterError;
use crate::observer::features::Features;
use crate::observer::field::{
    Announced, Coupling, Direction, Disturbance, FieldParams, FieldWords, HoldKind,
};
use crate::observer::network::Scratch;
use crate::observer::outer_law::combine;

/// Longest time for which a chip may stall while it erases: twice 2 s, in steps of 1 ms.
/// \[step\]
const STALL_MAX: Tick = 4_096;

/// Parameters and state of the field observer; none for the paper's.
#[derive(Clone, Debug)]
pub(super) struct Field<const N: usize, const FEATURES: usize> {
    /// One or none; an option would not be zero for none.
    params: heapless::Vec<FieldParams<N>, 1>,
    /// The models of the directions that the agent measures.
    disturbances: [Disturbance; N],
    /// Outer weights for samples, which do not adapt: those at the switch.
    outer_weights: heapless::Vec<StateVector<N>, FEATURES>,
    must_announce: bool,
    /// What measurements, neighbours and disturbances contributed to the last derivative.
    feedback: StateVector<N>,
}

impl<const N: usize, const FEATURES: usize> Field<N, FEATURES> {
    pub(super) const fn none() -> Self {
        Self {
            params: heapless::Vec::new(),
            disturbances: [Disturbance::NONE; N],
            outer_weights: heapless::Vec::new(),
            must_announce: false,
            feedback: zeros(),
        }
    }

    /// Returns the part of the last derivative that is not the network's, if the field observer is in
    /// use.
    pub(super) fn feedback(&self) -> Option<&StateVector<N>> {
        Some(&self.feedback).filter(|_| self.is_in_use())
    }

    pub(super) fn is_in_use(&self) -> bool {
        !self.params.is_empty()
    }

    /// Starts with the same parameters as after power-on, and with these outer weights for samples.
    pub(super) fn begin_again(&mut self, outer_weights: &[StateVector<N>]) {
        self.restart();
        self.outer_weights.clear();
        // There is room: as many as the agent has.
        let _ = self.outer_weights.extend_from_slice(outer_weights);
    }

    /// Starts again without a disturbance.
    pub(super) fn restart(&mut self) {
        self.disturbances = [Disturbance::NONE; N];
        self.must_announce = true;
        self.feedback = zeros();
    }
}

/// What samples are predicted with.
struct Prediction<'a, const N: usize, F> {
    params: &'a FieldParams<N>,
    network: Option<&'a F>,
    outer_weights: &'a [StateVector<N>],
    /// Digest of all that; 0 without a network.
    digest: u16,
    step_size: f32,
}

impl<const N: usize, F: Features> Prediction<'_, N, F> {
    /// Returns `f_hat` with these outer weights, from the limited state.
    #[inline(never)]
    fn flow(
        &self,
        outer_weights: &[StateVector<N>],
        state: &StateVector<N>,
        scratch: &mut Scratch,
    ) -> StateVector<N> {
        let input = self.params.limited(state);
        let features = self.network.and_then(|network| network.features(input.as_slice(), scratch));
        features.map_or(zeros(), |features| combine(outer_weights, features))
    }

    /// Whether this announcement can be followed by the model.
    fn follows(&self, announced: &Announced<N>) -> bool {
        announced.hold == HoldKind::Model && announced.digest == self.digest
    }

    /// Whether all neighbours that have been heard predict samples as this agent does.
    fn is_shared(&self, holds: &[Option<Hold<N>>]) -> bool {
        holds.iter().filter_map(Hold::present).all(|hold| match hold.announced() {
            Some(announced) => announced.digest == self.digest,
            None => false,
        })
    }

    /// Extrapolates a sample to `now`. Most are there already.
    #[inline]
    fn advance_to(&self, hold: &mut Hold<N>, now: Tick, scratch: &mut Scratch) {
        let behind = hold.behind(now);
        if behind > 0 {
            self.advance(hold, behind, scratch);
        }
    }

    /// Extrapolates a sample by this many steps, of which at most [`LAG_MAX`] count.
    #[inline(never)]
    fn advance(&self, hold: &mut Hold<N>, all_steps: u32, scratch: &mut Scratch) {
        let Some(announced) = hold.announced() else { return };
        let steps = all_steps.min(LAG_MAX);
        let rate = match announced.hold {
            HoldKind::ZeroOrder => zeros(),
            HoldKind::Rate => announced.rate,
            HoldKind::Model => {
                let mut rate = self.params.disturbance_of(announced);
                if self.follows(announced) {
                    let flow = self.flow(self.outer_weights, hold.estimate(), scratch);
                    add_scaled(&mut rate, 1.0, &flow);
                }
                rate
            }
        };
        let mut estimate = *hold.estimate();
        if announced.hold != HoldKind::ZeroOrder {
            add_scaled(&mut estimate, self.step_size * steps as f32, &rate);
            // A sample that is never renewed must not run away.
            estimate = self.params.limited(&estimate);
        }
        if all_finite(&estimate) {
            // In place: copies of announcements took an eighth of a step.
            let announced = hold.go_on(estimate, all_steps);
            for _ in 0..steps {
                self.params.move_on(announced);
            }
        }
    }
}

/// Returns the disturbance that a sample announces in direction `c`.
fn announced_in<const N: usize>(hold: &Hold<N>, c: usize) -> Option<&Disturbance> {
    hold.announced().and_then(|announced| announced.disturbance(c))
}

/// Returns the sample that an agent follows: its parent's, or the spare parent's if the parent is
/// silent for longer than the time-out and the spare is not.
#[inline(never)]
fn followed<'h, const N: usize>(
    direction: &Direction,
    timeout: u32,
    holds: &'h [Option<Hold<N>>],
    now: Tick,
) -> Option<&'h Hold<N>> {
    let hold = |place: Option<u8>| Hold::present(holds.get(usize::from(place?))?);
    let parent = hold(direction.parent);
    if timeout == 0 || direction.spare.is_none() {
        return parent;
    }
    let is_fresh = |hold: &&Hold<N>| hold.age_here(now) <= Tick::from(timeout);
    parent.filter(is_fresh).or(hold(direction.spare).filter(is_fresh)).or(parent)
}

impl<const N: usize, const FEATURES: usize, S> AgentState<N, FEATURES, S>
where
    S: HoldSlots<N>,
{
    /// Sets the field observer's parameters from the words of a package; none for the paper's
    /// observer. The outer weights at this time are those of its samples.
    ///
    /// # Errors
    /// Parameters out of range; nothing is changed.
    pub fn set_field(
        &mut self,
        params: &AgentParams<'_, N>,
        words: &[f32],
    ) -> Result<(), ParameterError> {
        let field = match words {
            [] => None,
            words => {
                let field = FieldParams::from_words(FieldWords(words))?;
                field.validate(params.outputs(), params.neighbours().len(), params.step_size())?;
                Some(field)
            }
        };
        let Self {
            field: Field { params, outer_weights, must_announce, disturbances, .. }, ..
        } = self;
        let is_kept = params.first().zip(field.as_ref()).is_some_and(|(old, new)| {
            // In other coordinates they mean something else.
            old.transform == new.transform
        });
        if !is_kept {
            *disturbances = [Disturbance::NONE; N];
        }
        params.clear();
        if let Some(field) = field {
            // A late sample evolves as announced, and not by the mean velocity.
            self.exchange = Exchange::new();
            // There is room: it was cleared.
            let _ = params.push(field);
        }
        outer_weights.clear();
        let _ = outer_weights.extend_from_slice(self.outer_weights.rows());
        *must_announce = true;
        Ok(())
    }

    /// Returns the field observer's parameters, if it is in use.
    #[must_use]
    pub fn field(&self) -> Option<&FieldParams<N>> {
        self.field.params.first()
    }

    /// Returns the disturbances that the agent estimates at the directions it measures.
    #[must_use]
    pub fn disturbances(&self) -> &[Disturbance; N] {
        &self.field.disturbances
    }

    /// Attempts a step as [`Self::attempt`] does, with the field observer. Frames are taken over even
    /// if the step is refused afterwards.
    #[inline(never)]
    pub(super) fn attempt_field<F, I>(
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
        let Self { field, scratch, exchange, .. } = self;
        let Field { params: own, disturbances, outer_weights: shipped, must_announce, feedback } =
            field;
        let Some(own) = own.first() else { return Err(StepError::Diverged) };
        let step_size = params.step_size;
        let network = network.filter(|_| own.options.uses_network);
        let digest = if network.is_some() { own.options.digest } else { 0 };
        let prediction =
            Prediction { params: own, network, outer_weights: shipped, digest, step_size };

        let holds = self.neighbour_holds.as_mut();
        let drained = take_over(exchange, params, inbox, holds, tick);
        self.stale_frames = drained.stale;
        let was_away = exchange.is_away();
        exchange.heard(&drained);
        if was_away {
            // Oscillations have gone on while the chip was stalled.
            let next = self.last_tick.map_or(tick, |last| last.saturating_add(1));
            for _ in 0..tick.saturating_sub(next).min(STALL_MAX) {
                for (direction, disturbance) in own.directions.iter().zip(disturbances.iter_mut()) {
                    *disturbance = direction.model.rotated(disturbance);
                }
            }
        }
        prediction.advance_to(&mut self.own_hold, tick, scratch);
        for_each(holds.iter_mut(), |slot| {
            if let Some(hold) = slot {
                prediction.advance_to(hold, tick, scratch);
            }
        });

        // Innovations and corrections, in the coordinates `xi`.
        let estimate = self.estimate;
        let (mut innovation, mut correction) = (zeros::<N>(), zeros::<N>());
        let mut consensus = zeros();
        let reference = match own.options.coupling {
            Coupling::Held => *self.own_hold.estimate(),
            _ => estimate,
        };
        let places = components_mut(&mut innovation)
            .iter_mut()
            .zip(components_mut(&mut correction))
            .zip(disturbances.iter());
        for ((c, direction), ((innovation, correction), disturbance)) in
            own.directions.iter().enumerate().zip(places)
        {
            let current = own.coordinate(c, &estimate);
            let mut sum = 0.0;
            if let Some(output) = direction.output {
                let measured = measurement.and_then(|values| values.get(usize::from(output)));
                if let Some(measured) = measured {
                    let nu = direction.scale * measured - current;
                    *innovation = nu;
                    sum += direction.root_gain * nu;
                }
                sum += direction.model.clipped(disturbance);
            }
            if own.options.coupling == Coupling::Trees {
                let followed = followed(direction, own.options.timeout, holds, tick);
                if direction.output.is_none()
                    && let Some(hold) = followed
                {
                    let share = params.exchange.share(hold.age_here(tick));
                    let difference = own.coordinate(c, hold.estimate()) - current;
                    sum += direction.tree_gain * share * difference;
                    if let Some(announced) = announced_in(hold, c) {
                        sum += direction.model.clipped(announced);
                    }
                }
            } else {
                let reference = own.coordinate(c, &reference);
                let mut term = 0.0;
                for (neighbour, hold) in params.neighbours().iter().zip(holds.iter()) {
                    let Some(hold) = Hold::present(hold) else { continue };
                    let share = params.exchange.share(hold.age_here(tick));
                    let difference = own.coordinate(c, hold.estimate()) - reference;
                    term += neighbour.weight * share * difference;
                }
                // In the state's units, like the hold error beside it in the trigger.
                own.shift(&mut consensus, c, term);
                sum += direction.tree_gain * term;
            }
            *correction = sum;
        }
        let mut output_error = zeros();
        if let Some(measurement) = measurement {
            let matrix = &params.observer.output_matrix;
            let _ = matrix.output_error(&estimate, measurement, &mut output_error);
        }

        let mut derivative = zeros();
        let mut adaptation = zeros();
        let amounts = components(&correction).iter().zip(components(&innovation));
        for (c, (&correction, &innovation)) in amounts.enumerate() {
            own.shift(&mut derivative, c, correction);
            own.shift(&mut adaptation, c, -innovation);
        }
        let by_feedback = derivative;
        let input = own.limited(&estimate);
        let features = network.and_then(|network| network.features(input.as_slice(), scratch));
        let mut planned = None;
        if let Some(features) = features {
            add_scaled(&mut derivative, 1.0, &self.outer_weights.combine(features));
            let adapts = own.options.adapts && network.is_some_and(Features::adapts);
            if adapts && measurement.is_some() {
                let law = &params.outer_law;
                let step = self.outer_weights.plan_step(law, step_size, features, &adaptation);
                planned = Some(step.ok_or(StepError::Diverged)?);
            }
        }
        let mut next = estimate;
        add_scaled(&mut next, step_size, &derivative);
        if !all_finite(&next) {
            return Err(StepError::Diverged);
        }

        // Nothing can fail from here on.
        for ((direction, disturbance), &nu) in
            own.directions.iter().zip(disturbances.iter_mut()).zip(components(&innovation))
        {
            let Some(output) = direction.output else { continue };
            let is_measured = measurement.is_some_and(|values| values.len() > usize::from(output));
            *disturbance = if is_measured {
                direction.model.corrected(disturbance, step_size * nu)
            } else {
                direction.model.unmeasured(disturbance, own.options.bias_kept)
            };
        }
        if let Some(planned) = &planned {
            self.outer_weights.commit(planned);
        }
        prediction.advance(&mut self.own_hold, 1, scratch);
        for_each(holds.iter_mut(), |slot| {
            if let Some(hold) = slot {
                prediction.advance(hold, 1, scratch);
            }
        });
        let sample = Sample { tick, estimate, derivative };
        *feedback = by_feedback;
        self.last_tick = Some(tick);
        self.estimate = next;
        self.consensus_term = consensus;
        self.consensus_is_current = false;
        self.output_error = output_error;

        // The trigger, at the next tick.
        let now = tick + 1;
        let held = self.own_hold.age(now);
        let event = match own.options.coupling {
            Coupling::Trees => {
                if params.exchange.repeat > 0
                    && echo::is_missing(own, &params.exchange, &self.own_hold, holds, tick)
                {
                    self.exchange.repeat_at(now);
                }
                is_due(own, &self.own_hold, &next, holds, now)
            }
            _ => {
                let hold_error = difference(self.own_hold.estimate(), &next);
                params.trigger.fires(held, &hold_error, &self.consensus_term)
            }
        };
        // A sample that neighbours can no longer follow is replaced at once.
        let is_followed = self.own_hold.announced().is_some_and(|announced| {
            announced.digest == digest
                && (announced.hold != HoldKind::Model || prediction.is_shared(holds))
        });
        let must = *must_announce || !is_followed;
        if !self.exchange.is_due(&params.exchange, event, now, held) && !must {
            return Ok(StepOutput { broadcast: None, sample });
        }
        *must_announce = false;
        let (announced, estimate) =
            announcement(&prediction, disturbances, &next, holds, now, scratch);
        let sequence = self.own_hold.sequence().wrapping_add(1);
        self.own_hold = Hold::new(estimate, now, sequence).announcing(announced);
        Ok(StepOutput { broadcast: Some(self.announcement(params)), sample })
    }
}

/// Whether a direction of the agent's sample has to be announced again.
#[inline(never)]
fn is_due<const N: usize>(
    own: &FieldParams<N>,
    sample: &Hold<N>,
    estimate: &StateVector<N>,
    holds: &[Option<Hold<N>>],
    now: Tick,
) -> bool {
    own.directions.iter().enumerate().filter(|(_, direction)| direction.is_announced).any(
        |(c, direction)| {
            let followed = match direction.output {
                Some(_) => None,
                None => followed(direction, own.options.timeout, holds, now),
            };
            let (state, radius) = match followed {
                Some(hold) => (hold.estimate(), own.options.relay_share * direction.radius),
                None => (estimate, direction.radius),
            };
            let error = difference(state, sample.estimate());
            let error = own.coordinate(c, &error);
            error >= radius || error <= -radius
        },
    )
}

/// Returns what the agent announces at `now`, and the sample with it.
#[inline(never)]
fn announcement<const N: usize, F: Features>(
    prediction: &Prediction<'_, N, F>,
    disturbances: &[Disturbance; N],
    estimate: &StateVector<N>,
    holds: &[Option<Hold<N>>],
    now: Tick,
    scratch: &mut Scratch,
) -> (Announced<N>, StateVector<N>) {
    let own = prediction.params;
    let hold = match own.options.hold {
        HoldKind::Model if prediction.network.is_none() || !prediction.is_shared(holds) => {
            HoldKind::Rate
        }
        hold => hold,
    };
    let mut sample = *estimate;
    let mut announced = Announced {
        digest: prediction.digest,
        hold,
        has_harmonics: own.options.has_harmonics,
        is_half: own.options.is_half,
        directions: 0,
        rate: zeros(),
        disturbances: [Disturbance::NONE; N],
    };
    let places = announced.disturbances.iter_mut().zip(disturbances);
    for (c, (direction, (place, own_disturbance))) in own.directions.iter().zip(places).enumerate()
    {
        let followed = match (own.options.coupling, direction.output) {
            (Coupling::Trees, None) => followed(direction, own.options.timeout, holds, now),
            _ => None,
        };
        match followed {
            // A relay announces its parent's sample.
            Some(hold) => {
                *place = announced_in(hold, c).copied().unwrap_or(Disturbance::NONE);
                if direction.is_announced {
                    let error = difference(hold.estimate(), estimate);
                    own.shift(&mut sample, c, own.coordinate(c, &error));
                }
            }
            None if direction.output.is_some() => *place = *own_disturbance,
            None => {}
        }
        if direction.is_announced && direction.model.clip > 0.0 {
            announced.directions |= 1 << c;
        }
    }
    if hold == HoldKind::Rate {
        // The rate holds for all directions, so it counts all disturbances that the agent knows.
        announced.rate = prediction.flow(prediction.outer_weights, &sample, scratch);
        let Announced { rate, disturbances, .. } = &mut announced;
        for (c, (direction, disturbance)) in own.directions.iter().zip(disturbances).enumerate() {
            own.shift(rate, c, direction.model.clipped(disturbance));
        }
        if !all_finite(&announced.rate) {
            announced.rate = zeros();
        }
    }
    for (c, place) in announced.disturbances.iter_mut().enumerate() {
        if announced.directions >> c & 1 == 0 {
            *place = Disturbance::NONE;
        } else if !own.options.has_harmonics {
            (place.cosine, place.sine) = (0.0, 0.0);
        }
    }
    announced.round(&mut sample);
    (announced, sample)
}

#[cfg(test)]
mod tests;
