//! One turn: what has arrived, one step, what there is to tell.

use agent_core::Tick;
use agent_core::agent::StepOutput;
use agent_core::agent::capture::Sample;
use agent_core::health::Advice;
use agent_core::service::{Outcome, State};
use agent_core::store::MappedFlash;
use agent_core::wire::frame::{FRAME_LENGTH_MAX, FrameError};

use super::{Node, Response, Rows, Session, count, respond};
use crate::board::Board;

impl<
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const GAINS: usize,
    const SAMPLES: usize,
> Node<'_, F, N, FEATURES, NEIGHBOURS, GAINS, SAMPLES>
{
    /// The turn of the newest of the `periods` that have begun.
    #[inline(never)]
    pub(super) fn turn<B: Board>(
        &mut self,
        session: Option<&Session<'_, N>>,
        board: &mut B,
        periods: u32,
    ) {
        // The last tick has no successor; a node gets there after 10^8 years.
        let tick = self.next_tick.saturating_add(Tick::from(periods.max(1)) - 1);
        self.next_tick = tick.saturating_add(1);
        let (outcome, sample) = match session {
            None => (Outcome::NoPackage, None),
            Some(session) => {
                self.take_frames(session, board);
                self.announce(session, board);
                self.step(session, board, tick)
            }
        };
        if let Some(sample) = &sample {
            self.memory.samples.offer(sample, self.settings.sample_stride);
        }
        if let Some(probation) = &mut self.probation
            && probation.observe(sample.is_some(), self.health.counters())
        {
            self.confirm(board, tick);
        }
        self.tell(session, board, tick, outcome, sample.as_ref());
    }

    /// Tells the neighbours the first sample, unless they know it.
    pub(super) fn announce<B: Board>(&mut self, session: &Session<'_, N>, board: &mut B) {
        let agent = &mut self.memory.agent;
        if !agent.announced {
            agent.announced = true;
            let frame = agent.state.announcement(&session.params).encode();
            if !board.broadcast(&frame) {
                count(&mut self.counts.broadcasts_lost);
            }
        }
    }

    fn take_frames<B: Board>(&mut self, session: &Session<'_, N>, board: &mut B) {
        let agent = &mut self.memory.agent;
        let mut buffer = [0; FRAME_LENGTH_MAX];
        // Not more than can be of use, so that a flood does not hold up the step.
        for _ in 0..2 * NEIGHBOURS {
            let Some(frame) = board.frame(&mut buffer) else { break };
            let accepted = match frame {
                Ok(bytes) => agent.inbox.accept_within(
                    session.params.neighbours(),
                    session.watch.plausible_region(),
                    bytes,
                ),
                Err(_) => Err(FrameError::Malformed),
            };
            if let Err(error) = accepted {
                self.health.frame_refused(&error);
            }
        }
    }

    /// Takes the step and broadcasts what it returns.
    fn step<B: Board>(
        &mut self,
        session: &Session<'_, N>,
        board: &mut B,
        tick: Tick,
    ) -> (Outcome, Option<Sample<N>>) {
        let Self { memory, store, health, counts, .. } = self;
        let agent = &mut memory.agent;
        let mut measurement = [0.0; N];
        let outputs = board.measure(&mut measurement);
        let Some(measurement) = outputs.and_then(|outputs| measurement.get(..outputs)) else {
            count(&mut counts.measurements_missing);
            return (Outcome::NoMeasurement, None);
        };
        let in_use = session.network.as_ref().filter(|_| health.network_in_use());
        let network = in_use.and_then(|(slot, place)| place.network(store.bytes(*slot)?));
        let params = &session.params;
        let stepped =
            agent.state.step(params, network.as_ref(), tick, measurement, &mut agent.inbox);
        let advice = health.observe(&session.watch, tick, &stepped, &agent.state);
        let mut broadcast = None;
        let (outcome, sample) = match stepped {
            Ok(StepOutput { broadcast: frame, sample }) => {
                broadcast = frame;
                (Outcome::Stepped, Some(sample))
            }
            Err(error) => (Outcome::from(&error), None),
        };
        let (outcome, sample) = match advice {
            Advice::Continue => (outcome, sample),
            Advice::Restart => {
                let zeros = [0.0; N];
                let weights = session.outer_weights(store).unwrap_or(&zeros);
                let (state, inbox) = (&mut agent.state, &mut agent.inbox);
                match health.restart(&session.watch, params, state, inbox, tick, weights) {
                    Ok(frame) => {
                        broadcast = Some(frame);
                        // What led there is nothing to learn from.
                        (Outcome::Restarted, None)
                    }
                    Err(_) => (outcome, sample),
                }
            }
        };
        if let Some(frame) = broadcast
            && !board.broadcast(&frame.encode())
        {
            count(&mut counts.broadcasts_lost);
        }
        (outcome, sample)
    }

    /// What somebody wants to know of this turn.
    fn tell<B: Board>(
        &mut self,
        session: Option<&Session<'_, N>>,
        board: &mut B,
        tick: Tick,
        outcome: Outcome,
        sample: Option<&Sample<N>>,
    ) {
        if let Some(session) = session
            && let Some(counters) = self.health.due(&session.watch, tick)
        {
            respond::<B, N>(board, &Response::Health { tick, counters });
        }
        let Some(every) = self.subscription.state_every else { return };
        if !agent_core::agent::capture::is_due(tick, every) {
            return;
        }
        let agent = session.map(|_| &self.memory.agent);
        let outer_weights = agent.filter(|_| self.subscription.outer_weights);
        let state = State {
            tick,
            outcome,
            estimate: agent.map_or(Rows(&[]), |agent| Rows::one(agent.state.estimate())),
            derivative: sample.map_or(Rows(&[]), |sample| Rows::one(&sample.derivative)),
            outer_weights: outer_weights
                .map_or(Rows(&[]), |agent| Rows(agent.state.outer_weights().rows())),
        };
        respond(board, &Response::State(state));
    }
}
