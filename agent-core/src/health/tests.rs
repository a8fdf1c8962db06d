//! Tests of counters, sequences of steps, restarts and reports, with an agent that estimates one
//! number.

use core::num::NonZeroU32;

use super::*;
use crate::agent::hold::Hold;
use crate::agent::region::Region;
use crate::agent::region::StateBox;
use crate::math::activation::Activation;
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use crate::observer::network::{Architecture, InnerNetwork, Layer};
use crate::observer::outer_law::OuterLawParams;
use crate::observer::projection::ProjectionParams;
use crate::observer::trigger::TriggerParams;
use nalgebra::SMatrix;

const NEIGHBOURS: [Neighbour; 1] = [Neighbour { id: 9, weight: 1.0 }];
const BOX: StateBox<'static> = StateBox { low: &[-1.0], high: &[3.0] };
const START: f32 = 0.5;
const WEIGHTS: [f32; 1] = [0.25];

const FALL_BACK: FallBack = FallBack {
    after: NonZeroU32::new(3).unwrap(),
    return_after: NonZeroU32::new(2).unwrap(),
    outside_box: true,
    projection_active: true,
    diverged: true,
};

const SETTINGS: HealthSettings = HealthSettings {
    fall_back: Some(FALL_BACK),
    plausible_margin: 10.0,
    restart_after: NonZeroU32::new(2),
    telemetry_interval: 10,
};

/// An agent with its health monitoring, and the tick of its next step. A step of 1/16 s with a gain
/// of 16 / s moves the estimate onto the measurement in one step.
struct Rig {
    agent: AgentParams<'static, 1>,
    params: HealthParams<1>,
    state: AgentState<1, 1, [Option<Hold<1>>; 1]>,
    inbox: Inbox<1, [Option<Hold<1>>; 1]>,
    health: Health,
    tick: Tick,
    advice: Advice,
}

fn agent() -> AgentParams<'static, 1> {
    AgentParams::new(
        4,
        0.0625,
        ObserverParams {
            output_matrix: OutputMatrix::new(&[[1.0].into()]).unwrap(),
            gain: SMatrix::from_diagonal_element(16.0),
            neighbours: &NEIGHBOURS,
        },
        OuterLawParams {
            gain: SymmetricMatrix::Scalar(1e-6),
            projection: ProjectionParams {
                radius: 2.0,
                boundary_layer: 1.0,
                smoothing: 0.1,
                smoothness: 1,
            },
        },
        TriggerParams { hold_error_weight: 1.0, consensus_weight: 0.0, threshold: 0.25 },
    )
    .unwrap()
}

impl Rig {
    fn new(settings: &HealthSettings, interval_min: f32) -> Self {
        let agent = agent();
        Self {
            params: HealthParams::new(&agent, &BOX, interval_min, settings).unwrap(),
            state: AgentState::new(&agent, [START].into(), &WEIGHTS, [None]).unwrap(),
            agent,
            inbox: Inbox::new([None]),
            health: Health::new(),
            tick: 0,
            advice: Advice::Continue,
        }
    }

    /// Takes a step with a network whose only feature is 1/2 + logistic(0), and with the
    /// measurement that gives the estimate `next`.
    fn step_to(&mut self, next: f32) -> Result<StepOutput<1>, StepError> {
        let layer = Layer { width: 1, activation: Activation::Logistic };
        let network =
            InnerNetwork::new(Architecture::new(1, &[layer]).unwrap(), [0.0, 0.0]).unwrap();
        let network = Some(&network).filter(|_| self.health.network_in_use());
        let feed_forward =
            network.map_or(0.0, |_| 0.5 * 0.0625 * self.state.outer_weights().rows()[0][0]);
        let measurement = [next - feed_forward];
        let outcome =
            self.state.step(&self.agent, network, self.tick, &measurement, &mut self.inbox);
        self.advice = self.health.observe(&self.params, self.tick, &outcome, &self.state);
        self.tick += 1;
        outcome
    }

    fn hear(&mut self, sequence: u32, tick: Tick, estimate: f32) {
        let frame = Frame::<1>::new(9, sequence, tick, [estimate].into());
        self.inbox.accept(&NEIGHBOURS, &frame.encode()).unwrap();
    }

    fn restart(&mut self) -> Frame<1> {
        let Self { agent, params, state, inbox, health, tick, .. } = self;
        health.restart(params, agent, state, inbox, *tick - 1, &WEIGHTS).unwrap()
    }
}

#[test]
fn a_healthy_agent_counts_nothing() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    for _ in 0..20 {
        rig.step_to(1.0).unwrap();
        assert_eq!(rig.advice, Advice::Continue);
    }
    assert_eq!(*rig.health.counters(), HealthCounters::default());
    assert_eq!(rig.health.due(&rig.params, rig.tick), None);
}

#[test]
fn fallback_and_return_follow_the_configured_steps() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    // Two steps outside and one inside are not three in a row.
    let outside = [(5.0, true), (5.0, true), (1.0, true), (5.0, true), (5.0, true), (5.0, false)];
    for (next, in_use) in outside {
        rig.step_to(next).unwrap();
        assert_eq!(rig.health.network_in_use(), in_use);
    }
    // A step refused because of its input neither interrupts nor extends a sequence.
    for (next, in_use) in
        [(1.0, false), (5.0, false), (1.0, false), (f32::NAN, false), (1.0, true), (5.0, true)]
    {
        assert_eq!(rig.step_to(next).is_ok(), next.is_finite());
        assert_eq!(rig.health.network_in_use(), in_use);
    }
    let expected = HealthCounters {
        outside_box: 7,
        measurements_not_finite: 1,
        fall_backs: 1,
        returns: 1,
        ..HealthCounters::default()
    };
    assert_eq!(*rig.health.counters(), expected);
}

#[test]
fn the_projection_counts_only_while_the_network_is_used() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    // Above theta_0 = 2, below the bound of 3.
    rig.state.replace_outer_weights(&rig.agent, &[2.5]).unwrap();
    for in_use in [true, true, false, false, true, true, true, false] {
        rig.step_to(1.0).unwrap();
        assert_eq!(rig.health.network_in_use(), in_use);
    }
    let counters = rig.health.counters();
    assert_eq!((counters.projection_active, counters.fall_backs, counters.returns), (6, 2, 1));
}

#[test]
fn only_selected_kinds_cause_a_fallback() {
    let fall_back = Some(FallBack { outside_box: false, ..FALL_BACK });
    for (fall_back, outside) in [(None, 5), (fall_back, 5)] {
        let mut rig = Rig::new(&HealthSettings { fall_back, ..SETTINGS }, 0.0);
        for _ in 0..outside {
            rig.step_to(5.0).unwrap();
        }
        assert!(rig.health.network_in_use());
        assert_eq!(rig.health.counters().outside_box, outside);
    }
}

#[test]
fn rounded_intervals_cause_no_false_alarm() {
    let interval = |seconds| Rig::new(&SETTINGS, seconds).params.interval_min();
    // At 16 steps per second.
    let cases = [(0.0, 0), (0.06, 0), (0.0625, 1), (0.2499, 3), (0.25, 4), (1e30, u32::MAX)];
    for (seconds, steps) in cases {
        assert_eq!(interval(seconds), steps, "{seconds}");
    }
    let mut rig = Rig::new(&SETTINGS, 0.2499);
    // Broadcasts at 3 (allowed), 5 (early), 8 (allowed) and 9 (early).
    for (tick, next) in (1..).zip([0.5, 0.5, 1.5, 1.5, 2.5, 2.5, 2.5, 1.5, 0.5]) {
        let broadcast = rig.step_to(next).unwrap().broadcast;
        assert_eq!(
            broadcast.map(|frame| frame.tick),
            [3, 5, 8, 9].into_iter().find(|&t| t == tick)
        );
    }
    let expected = HealthCounters { early_broadcasts: 2, ..HealthCounters::default() };
    assert_eq!(*rig.health.counters(), expected);
}

#[test]
fn every_refusal_has_its_counter() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    for next in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert!(rig.step_to(next).is_err());
    }
    rig.tick += 4;
    rig.step_to(1.0).unwrap();
    // Repeating a tick is refused and does not count as skipped.
    rig.tick -= 1;
    assert!(rig.step_to(1.0).is_err());
    let sender = 9;
    for error in [
        FrameError::NotFinite { sender },
        FrameError::Implausible { sender },
        FrameError::Implausible { sender },
        FrameError::Checksum,
        FrameError::DuplicateSender { sender },
        FrameError::UnknownSender { sender },
    ] {
        rig.health.frame_refused(&error);
    }
    for (sequence, tick) in [(5, 7), (5, 7), (4, 6), (6, 8)] {
        rig.hear(sequence, tick, 1.0);
        rig.step_to(1.0).unwrap();
    }
    let expected = HealthCounters {
        measurements_not_finite: 3,
        steps_refused: 1,
        skipped_ticks: 4,
        frames_not_finite: 1,
        frames_implausible: 2,
        frames_refused: 3,
        frames_stale: 2,
        ..HealthCounters::default()
    };
    assert_eq!(*rig.health.counters(), expected);
}

#[test]
fn counters_saturate() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    rig.health.counters.frames_refused = u32::MAX - 1;
    rig.health.counters.skipped_ticks = u32::MAX - 1;
    rig.step_to(1.0).unwrap();
    for _ in 0..3 {
        rig.health.frame_refused(&FrameError::Checksum);
        rig.tick += 1 << 40;
        rig.step_to(1.0).unwrap();
    }
    assert_eq!(rig.health.counters().frames_refused, u32::MAX);
    assert_eq!(rig.health.counters().skipped_ticks, u32::MAX);
}

#[test]
fn an_unusable_agent_restarts_and_its_sequence_continues() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    rig.step_to(40.0).unwrap();
    assert_eq!(rig.advice, Advice::Continue, "outside the box, inside the plausible region");
    rig.hear(3, 0, 1e30);
    rig.step_to(1.0).unwrap();
    assert_eq!(rig.advice, Advice::Restart);
    rig.hear(4, 1, 1e31);

    let other = rig.state.own_hold().sequence();
    let frame = rig.restart();
    assert_eq!((frame.sender, frame.sequence, frame.tick), (4, other.wrapping_add(1), 2));
    assert_eq!(frame.estimate, Region::<1>::copied(&BOX).unwrap().centre());
    assert_eq!(rig.state.estimate(), &frame.estimate);
    assert_eq!(rig.state.own_hold().estimate(), &frame.estimate);
    assert_eq!(rig.state.outer_weights().rows()[0][0], WEIGHTS[0]);
    assert_eq!(rig.state.neighbour_holds(), [None]);
    assert!(rig.inbox.is_empty());

    rig.hear(5, 2, 1.0);
    rig.step_to(1.0).unwrap();
    assert_eq!(rig.advice, Advice::Continue);
    assert_eq!(rig.health.counters().restarts, 1);
    assert_eq!(rig.health.counters().skipped_ticks, 0);
    assert!(rig.state.neighbour_holds()[0].is_some());
}

#[test]
fn only_consecutive_overflows_cause_a_restart() {
    let mut rig = Rig::new(&HealthSettings { fall_back: None, ..SETTINGS }, 0.0);
    let (go_on, restart) = (Advice::Continue, Advice::Restart);
    let max = f32::MAX;
    for (next, advice) in [
        (max, go_on),
        (1.0, go_on),
        (max, go_on),
        (f32::NAN, go_on),
        (max, restart),
        (max, restart),
    ] {
        let _ = rig.step_to(next);
        assert_eq!(rig.advice, advice);
    }
    rig.restart();
    for advice in [go_on, restart] {
        assert_eq!(rig.step_to(max), Err(StepError::Diverged));
        assert_eq!(rig.advice, advice);
    }
    let expected = HealthCounters {
        diverged: 6,
        measurements_not_finite: 1,
        restarts: 1,
        ..HealthCounters::default()
    };
    assert_eq!(*rig.health.counters(), expected);
}

#[test]
fn a_restart_keeps_neighbours_samples_and_can_be_refused() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    rig.hear(3, 0, 2.0);
    rig.step_to(1.0).unwrap();
    let held = rig.state.neighbour_holds()[0];
    let (estimate, own) = (*rig.state.estimate(), *rig.state.own_hold());
    let Rig { agent, params, state, inbox, health, .. } = &mut rig;
    for weights in [&[][..], &[f32::NAN], &[5.0], &[0.1, 0.1]] {
        assert!(health.restart(params, agent, state, inbox, 0, weights).is_err());
        assert_eq!((*state.estimate(), *state.own_hold()), (estimate, own));
        assert_eq!(health.counters().restarts, 0);
    }
    rig.restart();
    assert_eq!(rig.state.neighbour_holds(), [held]);
    // Time neither goes back nor passes the last tick.
    let weights = &WEIGHTS;
    let late = rig.state.restart(&rig.agent, 0, [1.0].into(), weights).unwrap();
    assert_eq!(late.tick, 1);
    let last = rig.state.restart(&rig.agent, Tick::MAX, [1.0].into(), weights).unwrap();
    assert_eq!(last.tick, Tick::MAX);
}

#[test]
fn without_a_limit_no_restart_is_advised() {
    let mut rig = Rig::new(&HealthSettings { restart_after: None, ..SETTINGS }, 0.0);
    rig.hear(3, 0, 1e38);
    for _ in 0..20 {
        let _ = rig.step_to(1.0);
        assert_eq!(rig.advice, Advice::Continue);
    }
    let counters = rig.health.counters();
    assert_eq!(counters.implausible + counters.diverged, 20);
}

#[test]
fn reports_are_rate_limited_and_need_a_change() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    let mut reports = [None; 60];
    for (tick, report) in (0..).zip(&mut reports) {
        // Refusals occur at ticks 3 to 20 and at 45.
        if (3..=20).contains(&tick) || tick == 45 {
            rig.health.frame_refused(&FrameError::Checksum);
        }
        *report = rig.health.due(&rig.params, tick).map(|counters| counters.frames_refused);
    }
    let mut expected = [None; 60];
    for (tick, count) in [(3, 1), (13, 11), (23, 18), (45, 19)] {
        expected[tick] = Some(count);
    }
    assert_eq!(reports, expected);
}

#[test]
fn refuses_invalid_settings() {
    let agent = agent();
    let with = |limits: &StateBox<'_>, interval, settings: &HealthSettings| {
        HealthParams::new(&agent, limits, interval, settings)
    };
    assert!(with(&BOX, 0.1, &SETTINGS).is_ok());
    for interval in [-1.0, f32::NAN, f32::INFINITY] {
        assert!(with(&BOX, interval, &SETTINGS).is_err());
    }
    for plausible_margin in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert!(with(&BOX, 0.0, &HealthSettings { plausible_margin, ..SETTINGS }).is_err());
    }
    let idle =
        FallBack { outside_box: false, projection_active: false, diverged: false, ..FALL_BACK };
    let idle = HealthSettings { fall_back: Some(idle), ..SETTINGS };
    assert!(with(&BOX, 0.0, &idle).is_err());
    for (low, high) in [(&[2.0][..], &[1.0][..]), (&[f32::NAN], &[1.0]), (&[0.0; 2], &[1.0; 2])] {
        assert!(with(&StateBox { low, high }, 0.0, &SETTINGS).is_err());
    }
}

#[test]
fn a_box_of_one_point_and_one_without_limits_leave_a_wide_plausible_region() {
    let agent = agent();
    let settings = HealthSettings { fall_back: None, ..SETTINGS };
    for (limits, outside) in [([1.0, 1.0], 2), ([f32::MIN, f32::MAX], 0)] {
        let limits = StateBox { low: &limits[..1], high: &limits[1..] };
        let mut rig = Rig::new(&settings, 0.0);
        rig.params = HealthParams::new(&agent, &limits, 0.0, &settings).unwrap();
        let ceiling = agent.ceiling();
        assert!((1e12..1e19).contains(&ceiling), "{ceiling}");
        assert_eq!(rig.params.plausible_region(), &Region::cube(ceiling));
        for next in [1.0, 1e9, -1e9] {
            rig.step_to(next).unwrap();
            assert_eq!(rig.advice, Advice::Continue);
        }
        // An overflow still causes a restart from the centre.
        for advice in [Advice::Continue, Advice::Restart] {
            assert_eq!(rig.step_to(f32::MAX), Err(StepError::Diverged));
            assert_eq!(rig.advice, advice);
        }
        assert_eq!(rig.restart().estimate[0], 0.5 * limits.low[0] + 0.5 * limits.high[0]);
        let expected = HealthCounters {
            outside_box: outside,
            // An error this large throws the outer weights onto their bound.
            projection_active: 2,
            diverged: 2,
            restarts: 1,
            ..HealthCounters::default()
        };
        assert_eq!(*rig.health.counters(), expected);
    }
}

#[test]
fn table_names_match_the_fields() {
    let counters =
        HealthCounters { outside_box: 1, frames_stale: 12, restarts: 15, ..<_>::default() };
    let values = counters.to_array();
    let found = HealthCounters::TABLE.iter().zip(values).filter(|(_, count)| *count > 0);
    let expected = [("outside_box", 1), ("frames_stale", 12), ("restarts", 15)];
    assert!(found.map(|((name, _), count)| (*name, count)).eq(expected));
    assert_eq!(HealthCounters::from_array(values), counters);
}

#[test]
fn a_sample_that_led_to_an_overflow_does_not_wait_for_ever() {
    const NO_NETWORK: Option<&InnerNetwork<&[f32]>> = None;
    let limits = StateBox { low: &[f32::MIN], high: &[f32::MAX] };
    for restart_after in [None, NonZeroU32::new(10)] {
        let settings = HealthSettings { fall_back: None, restart_after, ..SETTINGS };
        let mut rig = Rig::new(&settings, 0.0);
        rig.params = HealthParams::new(&rig.agent, &limits, 0.0, &settings).unwrap();
        let huge = Frame::<1>::new(9, (1 << 31) - 1, Tick::MAX, [3e38].into());
        // From before the region had a limit.
        rig.inbox.accept(&NEIGHBOURS, &huge.encode()).unwrap();
        let Rig { agent: params, params: health_params, state, inbox, health, .. } = &mut rig;
        let mut watched = WatchedAgent { params, health_params, state, inbox, health };
        let first = watched.step(NO_NETWORK, &WEIGHTS, 0, &[1.0]);
        assert_eq!(first, WatchedStep::Refused(StepError::Diverged));
        for tick in 1..100 {
            let step = watched.step(NO_NETWORK, &WEIGHTS, tick, &[1.0]);
            assert!(matches!(step, WatchedStep::Taken(_)), "{tick}: {step:?}");
        }
        // And now it is not even accepted.
        let refusal = watched.receive(&huge.encode());
        assert_eq!(refusal, Err(FrameError::Implausible { sender: 9 }));
        assert_eq!(rig.health.counters().diverged, 1);
    }
}

/// Ticks for which the chip was stalled are counted, but not held against the package.
#[test]
fn ticks_of_a_chip_that_stood_still_are_excused_once() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    rig.step_to(1.0).unwrap();
    rig.tick += 40;
    rig.health.excuse(30);
    rig.step_to(1.0).unwrap();
    let tally = rig.health.take_tally();
    assert_eq!((tally.skipped_ticks, tally.stalled_ticks), (10, 30));
    rig.tick += 5;
    rig.step_to(1.0).unwrap();
    let tally = rig.health.take_tally();
    assert_eq!((tally.skipped_ticks, tally.stalled_ticks), (5, 0));
    // More than were missed.
    rig.tick += 5;
    rig.health.excuse(9);
    rig.step_to(1.0).unwrap();
    let tally = rig.health.take_tally();
    assert_eq!((tally.skipped_ticks, tally.stalled_ticks), (0, 5));
    assert_eq!(rig.health.counters().skipped_ticks, 50);
}

/// What an erasure does to the innovation is not part of the record with which a package is compared.
#[test]
fn blocks_in_which_the_chip_stood_still_are_not_part_of_the_means() {
    let rig = Rig::new(&SETTINGS, 0.0);
    let mut performance = Performance::<1>::new(1, 0.0625);
    let mut block = |error: f32, stalled_ticks| {
        let tally = Tally { stalled_ticks, ..Tally::default() };
        for _ in 0..performance::BLOCK {
            let _ = performance.observe(Some(&[error]), false);
        }
        let _ = performance.end_block(&rig.agent, &rig.state, None, &tally);
        performance.means().map(|means| means.innovation)
    };
    let quiet = (0..40).map(|_| block(0.5, 0)).last().flatten();
    assert_eq!(quiet, Some(0.25));
    assert_eq!(block(8.0, 3), quiet);
    // Nor are those in which the estimate catches up.
    assert_eq!(block(2.0, 0), quiet);
    let later = (0..40).map(|_| block(1.0, 0)).last().flatten();
    assert!(later > quiet);
}

#[test]
fn samples_up_to_the_ceiling_cannot_make_a_step_overflow() {
    for sign in [1.0, -1.0] {
        let ceiling = agent().ceiling();
        let mut rig = Rig::new(&SETTINGS, 0.0);
        rig.state =
            AgentState::new(&rig.agent, [-sign * ceiling].into(), &WEIGHTS, [None]).unwrap();
        rig.hear(0, 0, sign * ceiling);
        rig.step_to(sign * ceiling).unwrap();
    }
}

#[test]
fn a_saturated_counter_is_named_and_does_not_hide_what_follows() {
    let mut rig = Rig::new(&SETTINGS, 0.0);
    rig.health.counters.frames_refused = u32::MAX;
    rig.health.counters.restarts = u32::MAX;
    let interval = Tick::from(SETTINGS.telemetry_interval);
    for number in 1..5 {
        rig.health.frame_refused(&FrameError::Checksum);
        assert!(rig.health.due(&rig.params, number * interval).is_some());
        assert!(rig.health.due(&rig.params, (number + 1) * interval).is_none());
    }
    assert!(rig.health.counters().saturated().eq(["frames_refused", "restarts"]));
    rig.health.take_tally();
    rig.step_to(1.0).unwrap();
    rig.restart();
    assert_eq!(rig.health.take_tally(), Tally { faults: 1, restarts: 1, ..Tally::default() });
    assert_eq!(rig.health.take_tally(), Tally::default());
}
