//! One turn: received frames, one step, and reports.

use agent_core::Tick;
use agent_core::agent::capture::Sample;
use agent_core::health::{Verdict, WatchedAgent, WatchedStep};
use agent_core::service::{Outcome, State, numbers};
use agent_core::store::MappedFlash;
use agent_core::wire::LENGTH_MAX;
use agent_core::wire::frame::FrameError;

use super::{Memory, Node, Response, respond};
use crate::board::{Board, SensorErrorKind};

impl<
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> Node<'_, F, N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// Takes a turn for the newest of the `periods` that have begun.
    #[inline(never)]
    pub(super) fn turn<B: Board>(&mut self, board: &mut B, periods: u32) {
        // No tick follows the last one, which a node reaches after 10^8 years.
        let tick = self.next_tick.saturating_add(Tick::from(periods.max(1)) - 1);
        self.next_tick = tick.saturating_add(1);
        if let Some(session) = self.memory.session.first() {
            self.limits.advance(periods, session.params.step_size());
        }
        // A chip that stalls while it erases has missed these ticks through no fault of the
        // package.
        let stalled =
            if core::mem::take(&mut self.flash_used) { periods.saturating_sub(1) } else { 0 };
        self.stalled_ticks = self.stalled_ticks.saturating_add(stalled);
        self.health.excuse(stalled);
        let (outcome, sample) = self.step(board, tick);
        let sample = sample.as_ref();
        if let Some(sample) = sample {
            self.memory.samples.offer(sample, self.settings.sample_stride);
        }
        let trial = self.trial.as_mut().filter(|_| self.store.is_on_trial());
        match trial.map(|trial| trial.at(tick)) {
            Some(Verdict::Passed) => self.confirm(board, tick),
            Some(Verdict::Failed(reason)) => self.end_trial(board, tick, reason),
            None | Some(Verdict::Running | Verdict::AwaitsOperator) => {}
        }
        self.tell(board, tick, outcome, sample);
    }

    /// Accepts received frames, takes the step, broadcasts its frame, and records how the package
    /// performs. Returns the outcome, and the sample for training if there is one.
    #[inline(always)] // Otherwise its result would be copied.
    fn step<B: Board>(&mut self, board: &mut B, tick: Tick) -> (Outcome, Option<Sample<N>>) {
        let Self { memory, store, health, counts, performance, trial, guard, .. } = self;
        let Memory { agent, session, .. } = &mut **memory;
        let Some(session) = session.first() else { return (Outcome::NoPackage, None) };
        let bytes = session.bytes(store);
        let Some(params) = session.params.params(bytes) else { return (Outcome::NoPackage, None) };
        agent.announce(&params, guard, board, counts);
        let mut watched = WatchedAgent {
            params: &params,
            health_params: &session.health_params,
            state: &mut agent.state,
            inbox: &mut agent.inbox,
            health,
        };
        let mut buffer = [0; LENGTH_MAX];
        // A limited number, so that a flood does not delay the step.
        for _ in 0..2 * NEIGHBOURS {
            let Some(frame) = board.frame(&mut buffer) else { break };
            match frame {
                // Refusals are counted.
                Ok(bytes) => guard.receive(&mut watched, bytes),
                Err(kind) => {
                    watched.health.frame_refused(&FrameError::Malformed);
                    counts.link(kind);
                }
            }
        }
        let mut measurement = [0.0; N];
        let outputs = board.measure(&mut measurement);
        let taken =
            outputs.and_then(|outputs| measurement.get(..outputs).ok_or(SensorErrorKind::Other));
        // Without a usable measurement the node keeps observing from its neighbours.
        let (measurement, unmeasured) = match taken {
            Ok(measurement) if measurement.iter().all(|value| value.is_finite()) => {
                (Some(measurement), None)
            }
            Ok(_) => {
                watched.health.measurement_refused();
                (None, Some(Outcome::MeasurementNotFinite))
            }
            Err(kind) => {
                counts.sensor(kind);
                (None, Some(Outcome::NoMeasurement))
            }
        };
        let network = session.network.as_ref().and_then(|(_, place)| place.network(bytes));
        let weights = session.outer_weights(bytes);
        let step = watched.attempt(network.as_ref(), weights, tick, measurement);
        if let Some(frame) = step.broadcast()
            && let Err(kind) = guard.broadcast(frame, board)
        {
            counts.not_sent(kind);
        }
        let last = agent.state.announcement(&params);
        if let Err(kind) = guard.greet(&last, tick, board) {
            counts.not_sent(kind);
        }
        let sample = step.sample().copied().filter(|_| unmeasured.is_none());
        let output_error = sample.is_some().then(|| agent.state.output_error(&params));
        if performance.observe(output_error, step.broadcast().is_some()) {
            let tally = health.take_tally();
            let last = measurement.zip(sample.as_ref().map(|sample| &sample.derivative));
            let block = performance.end_block(&params, &agent.state, last, &tally);
            if let Some(trial) = trial.as_mut().filter(|_| store.is_on_trial()) {
                let _ = trial.end_block(&block, &tally, tick);
            }
        } else if !matches!(step, WatchedStep::Taken(_))
            && let Some(trial) = trial.as_mut().filter(|_| store.is_on_trial())
        {
            let _ = trial.happened(health.tally());
        }
        let outcome = Outcome::from(&step);
        let outcome = unmeasured.filter(|_| outcome == Outcome::Stepped).unwrap_or(outcome);
        (outcome, sample)
    }

    /// Sends what is to be reported about this turn.
    fn tell<B: Board>(
        &mut self,
        board: &mut B,
        tick: Tick,
        outcome: Outcome,
        sample: Option<&Sample<N>>,
    ) {
        if let Some(session) = self.memory.session.first()
            && let Some(counters) = self.health.due(&session.health_params, tick)
        {
            respond(board, &Response::Health { tick, counters });
        }
        if let Some(counters) = self.counts.due(tick, self.settings.health.telemetry_interval) {
            respond(board, &Response::BoardErrors { tick, counters });
        }
        let Some(every) = self.subscription.state_every else { return };
        if !agent_core::agent::capture::is_due(tick, every) {
            return;
        }
        let agent = self.memory.session.first().map(|_| &self.memory.agent);
        let outer_weights = agent.filter(|_| self.subscription.outer_weights);
        let state = State {
            tick,
            outcome,
            estimate: agent.map_or(&[][..], |agent| agent.state.estimate().as_slice()),
            derivative: sample.map_or(&[][..], |sample| sample.derivative.as_slice()),
            outer_weights: outer_weights
                .map_or(&[][..], |agent| numbers(agent.state.outer_weights().rows())),
        };
        respond(board, &Response::State(state));
    }
}
