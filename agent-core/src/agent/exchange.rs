//! Exchange over links that lose and delay frames, with neighbours that fall silent.
//!
//! The paper's agents broadcast at events only, over links that deliver every frame at once. An event
//! whose frame is lost leaves the neighbours with an old sample until the next event, a delayed sample
//! describes a state that has passed, and the last sample of a neighbour that is gone is held for ever.
//! To counter this, an agent can
//! - broadcast at the latest after a *heartbeat*, keep a *gap* between broadcasts, and *repeat* each
//!   event with its newest estimate some time later;
//! - *fade* the weight `a_ij` of a neighbour by the age of its sample: full up to an age, then falling
//!   to zero at another;
//! - *compensate* delays: an arriving sample is extrapolated by its age times the agent's own mean velocity.
//!
//! # Farewells
//! An agent whose chip is about to stall, since it erases flash, says so. Its neighbours then have no
//! sample of it, rather than one that ages, and its first step afterwards broadcasts whether its trigger
//! fires or not. A neighbour that hears it again broadcasts, too, because the agent may have missed its
//! last sample meanwhile. None of this needs a parameter.
//!
//! # The age of a sample
//! Clocks of agents differ, so the age is counted on the receiver's. Since a frame arrived: its steps.
//! On its way: `arrival - tick`, of which the smallest value so far is taken for the difference of the
//! clocks plus the smallest delay of the link, which is a parameter. That minimum rises by one step in
//! [`LEAK`](crate::agent::hold::LEAK), for clocks that drift apart. A neighbour whose tick goes back, or whose frame would have
//! been under way for more than [`LAG_MAX`](crate::agent::hold::LAG_MAX) steps, has started again, and so does the estimate.
//!
//! # The mean velocity
//! `v` follows the derivative of the estimate with a time constant of `smoothing`. It feeds back what it
//! changes, so it must be slow: with a longest delay `D` and a gain `K` of the consensus term, `smoothing`
//! should be at least `2 D max(1, K D)`; the host warns below that.
//!
//! With all parameters 0 and without a farewell the agent is bit for bit the paper's. The feature `exchange` can be left out
//! where flash is short; then only the paper's exchange is accepted.
//!
//! Memory: `4 N + 12` bytes, and 24 bytes for each held sample. Cost: some 10 operations in a step, and
//! with fading the consensus term in every step.

use crate::agent::hold::Hold;
use crate::agent::inbox::Drained;
use crate::math::numeric::{add_scaled, all_finite, difference, zeros};
use crate::math::parameter::ParameterError;
use crate::{StateVector, Tick};

/// Whether the code for it is there. Without it, packages with such parameters are refused.
pub(crate) const ENABLED: bool = cfg!(feature = "exchange");

/// Parameters of the exchange, in steps; 0 turns each off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExchangeParams {
    /// Longest time between two broadcasts.
    pub heartbeat: u32,
    /// Shortest time between two broadcasts.
    pub gap: u32,
    /// Time after which the broadcast of an event is repeated, and the shortest between answers to neighbours
    /// that lack a sample of the field observer.
    pub repeat: u32,
    /// Age of a sample up to which it has its full weight.
    pub fade_from: u32,
    /// Age at which it has none left.
    pub fade_to: u32,
    /// Smallest delay of the link.
    pub delay: u32,
    /// Time constant of the mean velocity by which late samples are extrapolated.
    pub smoothing: u32,
}

impl ExchangeParams {
    /// The paper's exchange.
    pub const PAPER: Self =
        Self { heartbeat: 0, gap: 0, repeat: 0, fade_from: 0, fade_to: 0, delay: 0, smoothing: 0 };

    /// Number of parameters.
    pub(crate) const COUNT: usize = 7;

    /// Returns all parameters, in the order of packages.
    pub(crate) fn words(&self) -> [u32; Self::COUNT] {
        let Self { heartbeat, gap, repeat, fade_from, fade_to, delay, smoothing } = *self;
        [heartbeat, gap, repeat, fade_from, fade_to, delay, smoothing]
    }

    /// Returns the parameters from their words in a package.
    pub(crate) fn from_words(words: &[u32; Self::COUNT]) -> Self {
        let [heartbeat, gap, repeat, fade_from, fade_to, delay, smoothing] = *words;
        Self { heartbeat, gap, repeat, fade_from, fade_to, delay, smoothing }
    }

    /// Checks that no parameter contradicts another one.
    ///
    /// # Errors
    /// A gap above the heartbeat, or a fading that ends before it begins.
    pub fn validate(&self) -> Result<(), ParameterError> {
        let out_of_range = |parameter, value: u32, expected| ParameterError::OutOfRange {
            parameter,
            value: value as f32,
            expected,
        };
        if self.heartbeat > 0 && self.gap > self.heartbeat {
            return Err(out_of_range("exchange.gap", self.gap, "at most exchange.heartbeat"));
        }
        if self.fade_from > self.fade_to {
            return Err(out_of_range(
                "exchange.fade_from",
                self.fade_from,
                "at most exchange.fade_to",
            ));
        }
        Ok(())
    }

    /// Whether this is the paper's exchange.
    #[inline]
    pub(crate) fn is_papers(&self) -> bool {
        !ENABLED || *self == Self::PAPER
    }

    /// Whether the weights of neighbours depend on the time.
    #[inline]
    pub(crate) fn fades(&self) -> bool {
        ENABLED && self.fade_to > 0
    }

    /// Whether late samples are extrapolated.
    #[inline]
    pub(crate) fn compensates(&self) -> bool {
        ENABLED && self.smoothing > 0
    }

    /// Returns the share of the weight that a sample of this age keeps.
    #[inline]
    pub(crate) fn share(&self, age: Tick) -> f32 {
        if !self.fades() || age <= Tick::from(self.fade_from) {
            return 1.0;
        }
        let left = Tick::from(self.fade_to).saturating_sub(age);
        let width = self.fade_to.saturating_sub(self.fade_from).max(1);
        left as f32 / width as f32
    }
}

/// What an agent remembers for the exchange.
#[derive(Clone, Debug)]
pub(crate) struct Exchange<const N: usize> {
    /// When the last event is repeated; 0 for never.
    repeat_at: Tick,
    /// The mean velocity. \[state unit/s\]
    velocity: StateVector<N>,
    /// Whether neighbours may lack the agent's sample: it has said farewell, or one of them had.
    #[cfg(feature = "exchange")]
    must_speak: bool,
}

impl<const N: usize> Exchange<N> {
    pub(crate) const fn new() -> Self {
        Self {
            repeat_at: 0,
            velocity: zeros(),
            #[cfg(feature = "exchange")]
            must_speak: false,
        }
    }

    /// Says farewell; returns whether that is news.
    #[cfg(feature = "exchange")]
    pub(crate) fn leave(&mut self) -> bool {
        !core::mem::replace(&mut self.must_speak, true)
    }

    /// Takes note of the frames that have arrived.
    #[inline]
    pub(crate) fn heard(&mut self, drained: &Drained) {
        #[cfg(feature = "exchange")]
        {
            self.must_speak |= drained.has_returned;
        }
        #[cfg(not(feature = "exchange"))]
        let _ = drained;
    }

    /// Returns whether the agent has said farewell and not broadcast since; to be asked before frames are
    /// taken over.
    #[cfg(feature = "field")]
    #[inline]
    pub(crate) fn is_away(&self) -> bool {
        #[cfg(feature = "exchange")]
        {
            self.must_speak
        }
        #[cfg(not(feature = "exchange"))]
        {
            false
        }
    }

    /// Takes the obligation to broadcast, if there is one.
    #[inline]
    fn take_obligation(&mut self) -> bool {
        #[cfg(feature = "exchange")]
        {
            core::mem::take(&mut self.must_speak)
        }
        #[cfg(not(feature = "exchange"))]
        {
            false
        }
    }

    /// Returns whether to broadcast at `tick`, `held` steps after the last broadcast; `event` says
    /// whether the trigger fires.
    #[inline]
    pub(crate) fn is_due(
        &mut self,
        params: &ExchangeParams,
        event: bool,
        tick: Tick,
        held: Tick,
    ) -> bool {
        let must_speak = self.take_obligation();
        let event = event || must_speak;
        if params.is_papers() {
            return event;
        }
        if held < Tick::from(params.gap) && !must_speak {
            return false;
        }
        let repeats = self.repeat_at != 0 && tick >= self.repeat_at;
        let beats = params.heartbeat > 0 && held >= Tick::from(params.heartbeat);
        if event && params.repeat > 0 {
            self.repeat_at = tick.saturating_add(Tick::from(params.repeat));
        } else if repeats {
            self.repeat_at = 0;
        }
        event || repeats || beats
    }

    /// Repeats the agent's sample at `tick`, or as soon as the gap allows.
    #[cfg(feature = "field")]
    pub(crate) fn repeat_at(&mut self, tick: Tick) {
        self.repeat_at = tick;
    }

    /// Adds the derivative of a step to the mean velocity.
    #[inline]
    pub(crate) fn follow(&mut self, params: &ExchangeParams, derivative: &StateVector<N>) {
        if params.compensates() {
            let change = difference(derivative, &self.velocity);
            add_scaled(&mut self.velocity, 1.0 / params.smoothing as f32, &change);
            if !all_finite(&self.velocity) {
                self.velocity = zeros();
            }
        }
    }

    /// Returns a sample that arrives at the receiver's step `now`, in place of `held`: with its time in
    /// transit, and extrapolated by it.
    #[inline]
    pub(crate) fn arrived(
        &self,
        params: &ExchangeParams,
        step_size: f32,
        sample: &Hold<N>,
        held: Option<&Hold<N>>,
        now: Tick,
    ) -> Hold<N> {
        let mut hold = sample.taken_over(now);
        if params.is_papers() {
            return hold;
        }
        hold.measure_lag(held, params.delay);
        if params.compensates() && hold.lag() > 0 {
            hold.move_on(&self.velocity, hold.lag() as f32 * step_size);
        }
        hold
    }
}

#[cfg(all(test, feature = "exchange"))]
mod tests {
    extern crate std;

    use std::vec::Vec;

    use super::*;
    use crate::agent::inbox::Inbox;
    use crate::agent::region::Region;
    use crate::agent::{AgentParams, AgentState};
    use crate::health::performance::disagreement;
    use crate::math::symmetric::SymmetricMatrix;
    use crate::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
    use crate::observer::network::InnerNetwork;
    use crate::observer::outer_law::OuterLawParams;
    use crate::observer::projection::ProjectionParams;
    use crate::observer::trigger::TriggerParams;
    use crate::wire::frame::Frame;

    /// Returns the ticks of the broadcasts in 100 steps of an agent that broadcasts at 0 and whose
    /// trigger fires from the step on at which `event` says so until it has broadcast.
    fn broadcasts(params: ExchangeParams, event: impl Fn(Tick) -> bool) -> Vec<Tick> {
        let (mut exchange, mut last, mut waiting) = (Exchange::<1>::new(), 0, false);
        let mut ticks = Vec::new();
        for tick in 1..100 {
            waiting |= event(tick);
            if exchange.is_due(&params, waiting, tick, tick - last) {
                (last, waiting) = (tick, false);
                ticks.push(tick);
            }
        }
        ticks
    }

    #[test]
    fn broadcasts_follow_events_heartbeats_gaps_and_repetitions() {
        let off = ExchangeParams::PAPER;
        let at = |ticks: &'static [Tick]| move |tick| ticks.contains(&tick);
        assert_eq!(broadcasts(off, at(&[])), []);
        assert_eq!(broadcasts(off, at(&[7, 8])), [7, 8]);
        let heartbeat = ExchangeParams { heartbeat: 30, ..off };
        assert_eq!(broadcasts(heartbeat, at(&[10, 60])), [10, 40, 60, 90]);
        let gap = ExchangeParams { gap: 5, ..off };
        // An event within the gap waits for its end.
        assert_eq!(broadcasts(gap, at(&[7, 8, 20])), [7, 12, 20]);
        let repeat = ExchangeParams { repeat: 4, ..off };
        assert_eq!(broadcasts(repeat, at(&[10, 50, 52])), [10, 14, 50, 52, 56]);
        // A repetition that an event or the gap anticipates is not made twice.
        let both = ExchangeParams { repeat: 4, gap: 6, ..off };
        assert_eq!(broadcasts(both, at(&[10, 50, 52])), [10, 16, 50, 56, 62]);
    }

    #[test]
    fn the_weight_of_a_sample_falls_with_its_age() {
        let fades = ExchangeParams { fade_from: 10, fade_to: 20, ..ExchangeParams::PAPER };
        let shares = [0, 10, 11, 15, 19, 20, 21, Tick::MAX].map(|age| fades.share(age));
        assert_eq!(shares, [1.0, 1.0, 0.9, 0.5, 0.1, 0.0, 0.0, 0.0]);
        let drops = ExchangeParams { fade_from: 10, fade_to: 10, ..ExchangeParams::PAPER };
        assert_eq!([9, 10, 11].map(|age| drops.share(age)), [1.0, 1.0, 0.0]);
        assert_eq!(ExchangeParams::PAPER.share(Tick::MAX), 1.0);
    }

    /// Returns the estimated time in transit of each sample, given by its tick and its arrival.
    fn lags(delay: u32, samples: impl IntoIterator<Item = (Tick, Tick)>) -> Vec<u32> {
        let mut held: Option<Hold<1>> = None;
        let lag = |(sequence, (tick, arrival)): (u32, (Tick, Tick))| {
            let mut hold = Hold::new([0.0].into(), tick, sequence).taken_over(arrival);
            hold.measure_lag(held.as_ref(), delay);
            held = Some(hold);
            hold.lag()
        };
        (0..).zip(samples).map(lag).collect()
    }

    #[test]
    fn the_lag_is_measured_against_the_quickest_frame() {
        // The sender's clock is 500 ahead, then 500 behind; the quickest frame takes 3.
        for ahead in [500, -500_i64] {
            let delays = [5, 3, 9, 3, 4];
            let samples = (0..).zip(delays).map(|(k, delay)| {
                let sent: Tick = 1_000 + 20 * k;
                (sent.saturating_add_signed(ahead), sent + delay)
            });
            assert_eq!(lags(3, samples), [3, 3, 9, 3, 4]);
        }
    }

    #[test]
    fn the_lag_follows_clocks_that_drift_apart() {
        // The receiver's clock gains 100 ppm, so that arrivals seem later and later.
        let samples = (0..2_000).map(|k: u64| (1_000 * k, 1_000 * k + k / 10 + 7));
        let lags = lags(7, samples);
        assert!(lags.iter().all(|&lag| lag <= 8), "{:?}", lags.iter().max());
    }

    #[test]
    fn a_sender_that_starts_again_is_measured_again() {
        let again = [(50_000, 50_003), (10, 50_103), (20, 50_115)];
        assert_eq!(lags(3, again), [3, 3, 5]);
        // Its clock is set back by an hour, or a frame is played back.
        let leap = [(5_000_000, 100), (5_000_010, 3_000_110), (5_000_020, 3_000_121)];
        assert_eq!(lags(0, leap), [0, 0, 1]);
        for extreme in [(0, Tick::MAX), (Tick::MAX, 0), (Tick::MAX, Tick::MAX)] {
            assert_eq!(lags(2, [(5, 5), extreme, extreme])[0], 2);
        }
    }

    const NEIGHBOURS: [Neighbour; 1] = [Neighbour { id: 9, weight: 2.0 }];

    fn params(exchange: ExchangeParams) -> AgentParams<'static, 1> {
        let observer = ObserverParams {
            output_matrix: OutputMatrix::new(&[[1.0].into()]).unwrap(),
            gain: SymmetricMatrix::Scalar(1.0).unfold(),
            neighbours: &NEIGHBOURS,
        };
        let projection =
            ProjectionParams { radius: 9.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
        let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection };
        let trigger =
            TriggerParams { hold_error_weight: 1e-9, consensus_weight: 0.0, threshold: 1e9 };
        let params = AgentParams::new(1, 1e-3, observer, outer_law, trigger).unwrap();
        params.with_exchange(exchange).unwrap()
    }

    #[test]
    fn a_silent_neighbour_leaves_the_consensus_term() {
        const NO_NETWORK: Option<&InnerNetwork<&[f32]>> = None;
        let fades = ExchangeParams { fade_from: 2, fade_to: 4, ..ExchangeParams::PAPER };
        for (exchange, expected) in [
            (ExchangeParams::PAPER, [20.0, 20.0, 20.0, 20.0, 20.0, 20.0]),
            (fades, [20.0, 20.0, 20.0, 10.0, 0.0, 0.0]),
        ] {
            let params = params(exchange);
            let mut state =
                AgentState::<1, 1, _>::new(&params, [0.0].into(), &[0.0], [None]).unwrap();
            let mut inbox = Inbox::new([None]);
            let frame = Frame::new(9, 0, 0, [10.0].into());
            inbox.accept(&NEIGHBOURS, &frame.encode()).unwrap();
            let terms = expected.map(|_| {
                let tick = state.last_tick.map_or(0, |tick| tick + 1);
                state.step(&params, NO_NETWORK, tick, &[0.0], &mut inbox).unwrap();
                state.consensus_term()[0]
            });
            assert_eq!(terms, expected);
        }
    }

    /// An agent with the neighbour 9, whose own trigger never fires.
    struct Listener {
        params: AgentParams<'static, 1>,
        state: AgentState<1, 1, [Option<Hold<1>>; 1]>,
        inbox: Inbox<1, [Option<Hold<1>>; 1]>,
        next: Tick,
    }

    impl Listener {
        fn new(exchange: ExchangeParams) -> Self {
            let params = params(exchange);
            let state = AgentState::new(&params, [0.0].into(), &[0.0], [None]).unwrap();
            Self { params, state, inbox: Inbox::new([None]), next: 0 }
        }

        /// Takes a step in which these frames arrive; returns consensus term and frame.
        fn step(&mut self, frames: &[Frame<1>]) -> (f32, Option<Frame<1>>) {
            const NO_NETWORK: Option<&InnerNetwork<&[f32]>> = None;
            let region = Region::new([5.0].into(), [50.0].into()).unwrap();
            for frame in frames {
                let _ = self.inbox.accept_within(&NEIGHBOURS, &region, &frame.encode());
            }
            let Self { params, state, inbox, next, .. } = self;
            let output = state.step(params, NO_NETWORK, *next, &[0.0], inbox).unwrap();
            *next += 1;
            (state.consensus_term()[0], output.broadcast)
        }

        fn is_absent(&self) -> bool {
            self.state.neighbour_holds()[0].is_some_and(|hold| hold.is_absent())
        }
    }

    fn sample(sequence: u32, estimate: f32) -> Frame<1> {
        Frame::new(9, sequence, Tick::from(sequence), [estimate].into())
    }

    fn farewell(sequence: u32) -> Frame<1> {
        Frame::farewell(9, sequence, sequence.into())
    }

    #[test]
    fn a_neighbour_that_says_farewell_is_left_out_until_its_next_frame() {
        let fades = ExchangeParams { fade_from: 500, fade_to: 900, ..ExchangeParams::PAPER };
        for exchange in [ExchangeParams::PAPER, fades] {
            let mut listener = Listener::new(exchange);
            assert_eq!(listener.step(&[sample(4, 10.0)]), (20.0, None));
            assert!(disagreement(&listener.state).is_some());
            // The plausible region does not contain 0, which a farewell does not mean.
            assert_eq!(listener.step(&[farewell(5)]), (0.0, None));
            assert_eq!(disagreement(&listener.state), None);
            assert!(listener.is_absent());
            assert_eq!(listener.step(&[]), (0.0, None));
            // What was sent before it, and its repetition, change nothing.
            for old in [sample(4, 10.0), sample(3, 30.0), farewell(5), farewell(4)] {
                assert_eq!(listener.step(&[old]), (0.0, None));
                assert_eq!(listener.state.stale_frames(), 1);
                assert!(listener.is_absent());
            }
            // The next frame brings it back, and is answered once, since it may have missed a sample.
            let (term, answer) = listener.step(&[sample(6, 15.0)]);
            assert_eq!((term, answer.map(|frame| frame.sequence)), (30.0, Some(1)));
            assert!(!listener.is_absent());
            for old in [farewell(5), sample(5, 40.0)] {
                let (term, frame) = listener.step(&[old]);
                assert_eq!((listener.state.stale_frames(), frame), (1, None));
                assert!(term > 25.0 && !listener.is_absent());
            }
        }
    }

    #[test]
    fn the_newest_of_a_farewell_and_a_sample_counts() {
        for order in [[0, 1], [1, 0]] {
            for (frames, absent) in
                [([farewell(5), sample(6, 10.0)], false), ([sample(5, 10.0), farewell(6)], true)]
            {
                let mut listener = Listener::new(ExchangeParams::PAPER);
                listener.step(&[sample(4, 20.0)]);
                listener.step(&order.map(|place| frames[place]));
                assert_eq!(listener.is_absent(), absent);
            }
        }
        // Before the first sample.
        let mut listener = Listener::new(ExchangeParams::PAPER);
        assert_eq!(listener.step(&[farewell(5)]), (0.0, None));
        assert_eq!(listener.step(&[sample(5, 10.0)]), (0.0, None));
        assert_eq!(listener.step(&[sample(6, 10.0)]).0, 20.0);
    }

    #[test]
    fn a_neighbour_that_restarts_after_its_farewell_is_heard_after_the_silence() {
        let mut listener = Listener::new(ExchangeParams::PAPER);
        listener.params = listener.params.with_restart_silence(3);
        listener.step(&[sample(400, 10.0)]);
        let terms = [farewell(401), sample(0, 10.0), sample(1, 10.0), sample(2, 10.0)]
            .map(|frame| listener.step(&[frame]).0);
        assert_eq!(terms, [0.0; 4]);
        assert_eq!(listener.step(&[sample(3, 10.0)]).0, 20.0);
    }

    #[test]
    fn after_a_farewell_the_next_step_broadcasts_once() {
        let gap = ExchangeParams { gap: 50, ..ExchangeParams::PAPER };
        let beats = ExchangeParams { heartbeat: 90, repeat: 3, ..ExchangeParams::PAPER };
        for (exchange, repeats) in [(ExchangeParams::PAPER, false), (gap, false), (beats, true)] {
            let mut agent = Listener::new(exchange);
            agent.step(&[]);
            let frame = agent.state.farewell(1).unwrap();
            assert_eq!(frame, Frame::farewell(1, 1, 1));
            assert!(agent.state.farewell(1).is_none());
            // The chip stalls for 30 ticks.
            agent.next += 30;
            let back = agent.step(&[]).1.unwrap();
            assert_eq!((back.sequence, back.tick, back.is_farewell), (2, 32, false));
            assert_eq!(back.estimate, *agent.state.estimate());
            let next = [(); 4].map(|()| agent.step(&[]).1.is_some());
            assert_eq!(next, [false, false, repeats, false]);
            // Another one takes the next number.
            assert_eq!(agent.state.farewell(1).unwrap().sequence, if repeats { 4 } else { 3 });
        }
    }

    #[test]
    fn a_refused_step_does_not_use_up_the_obligation() {
        const NO_NETWORK: Option<&InnerNetwork<&[f32]>> = None;
        let mut agent = Listener::new(ExchangeParams::PAPER);
        let _ = agent.state.farewell(1);
        let Listener { params, state, inbox, .. } = &mut agent;
        assert!(state.step(params, NO_NETWORK, 0, &[f32::NAN], inbox).is_err());
        assert!(agent.step(&[]).1.is_some());
        assert!(agent.step(&[]).1.is_none());
    }

    #[test]
    fn a_late_sample_is_moved_on_by_the_mean_velocity() {
        let exchange = ExchangeParams { delay: 10, smoothing: 2, ..ExchangeParams::PAPER };
        let mut state = Exchange::<1>::new();
        state.follow(&exchange, &[4.0].into());
        assert_eq!(state.velocity[0], 2.0);
        let sample = Hold::new([1.0].into(), 90, 0);
        let arrived = state.arrived(&exchange, 1e-3, &sample, None, 100);
        assert_eq!(arrived.estimate()[0], 1.0 + 2.0 * (10.0 * 1e-3));
        assert_eq!(arrived.age_here(105), 15);
        // Numbers that overflow do not reach the observer.
        state.follow(&exchange, &[f32::MAX].into());
        state.follow(&exchange, &[-f32::MAX].into());
        assert!(state.velocity[0].is_finite());
        let largest = Hold::new([f32::MAX].into(), 90, 0);
        state.velocity = [f32::MAX].into();
        let arrived = state.arrived(&exchange, 1e30, &largest, None, 100);
        assert_eq!(arrived.estimate()[0], f32::MAX);
    }

    #[test]
    fn contradictions_are_refused() {
        let params = |exchange: ExchangeParams| exchange.validate().is_ok();
        assert!(params(ExchangeParams::PAPER));
        let off = ExchangeParams::PAPER;
        assert!(params(ExchangeParams { gap: 5, ..off }));
        assert!(!params(ExchangeParams { gap: 5, heartbeat: 4, ..off }));
        assert!(!params(ExchangeParams { fade_from: 5, fade_to: 4, ..off }));
    }
}
