//! Run-time faults: agents that received invalid data for a while recover completely, every event
//! is counted exactly, and repeated frames change nothing.

use std::num::NonZeroU32;

use agent_core::health::{FallBack, HealthCounters, HealthSettings};
use agent_core::wire::frame::Frame;
use agent_core::{StateVector, Tick};
use proptest::prelude::*;
use test_support::close;

use crate::core::random_network::Draw;
use crate::core::watched_ring::{BOX, Ring};

pub(crate) const SETTINGS: HealthSettings = HealthSettings {
    fall_back: Some(FallBack {
        after: NonZeroU32::new(5).unwrap(),
        return_after: NonZeroU32::new(50).unwrap(),
        outside_box: true,
        projection_active: false,
        diverged: true,
    }),
    plausible_margin: 10.0,
    restart_after: NonZeroU32::new(10),
    telemetry_interval: 100,
};

/// Steps of a run before a disturbance, and between its end and the comparison.
const SETTLED: Tick = 1_000;
/// Steps over which errors are compared.
const JUDGED: Tick = 3_000;

/// Whether two error levels are equal. The runs diverge with the first disturbance: broadcasts fall
/// on other steps, and outer weights are reset. In 300 random cases the ratio was 0.97 to 1.07;
/// outer weights that stay on their bound make it 1.8.
fn same_level(found: [f64; 3], expected: [f64; 3]) -> bool {
    let norm = |levels: [f64; 3]| levels.iter().map(|level| level * level).sum::<f64>().sqrt();
    close(norm(found), norm(expected), 0.2, 0.0)
}

/// Returns a measurement that no sensor of this point gives: NaN, infinite, or huge.
fn nonsense(draw: &mut Draw) -> f32 {
    let sizes = [f32::NAN, f32::INFINITY, 1e4, 1e9, 1e19, 1e30, 3e38];
    let value = sizes[draw.whole(0, sizes.len() - 1)];
    if draw.whole(0, 1) == 0 { -value } else { value }
}

/// Returns a valid frame that no agent has sent: a huge estimate with an arbitrary sequence.
fn huge_frame(draw: &mut Draw) -> Frame<3> {
    Frame::new(
        draw.whole(0, 2) as u32,
        draw.whole(0, u32::MAX as usize) as u32,
        draw.whole(0, 1 << 40) as Tick,
        StateVector::from_fn(|_, _| {
            let size = draw.positive(1e7, 3e38);
            if draw.whole(0, 1) == 0 { -size } else { size }
        }),
    )
}

/// Feeds invalid data to agents and links for a while.
fn disturb(ring: &mut Ring, draw: &mut Draw) {
    for _ in 0..draw.whole(1, 300) {
        if draw.whole(0, 9) == 0 {
            ring.inject(&huge_frame(draw));
        }
        ring.step(|_, measurement| {
            if draw.whole(0, 1) == 0 {
                *measurement = nonsense(draw);
            }
        });
    }
}

/// Returns a ring in its steady state.
fn settled(seed: u64, settings: &HealthSettings, guarded: bool) -> Ring {
    let mut ring = Ring::new(seed, settings);
    ring.guarded = guarded;
    ring.skip(SETTLED);
    ring
}

/// Returns the error levels of a ring after a disturbance and of one without, at the same time.
fn levels(seed: u64, guarded: bool) -> ([f64; 3], [f64; 3]) {
    let mut draw = Draw::new(!seed);
    let mut disturbed = settled(seed, &SETTINGS, guarded);
    disturb(&mut disturbed, &mut draw);
    disturbed.skip(SETTLED);
    let mut calm = settled(seed, &SETTINGS, guarded);
    calm.skip(disturbed.tick - calm.tick);
    (disturbed.error_level(JUDGED), calm.error_level(JUDGED))
}

/// Returns a ring whose agents all received a frame of 1e30 a second ago.
fn carried_off(settings: &HealthSettings) -> Ring {
    let mut ring = settled(1, settings, false);
    for sender in [0, 1] {
        let (sequence, estimate) = (1 << 20, StateVector::repeat(1e30));
        ring.inject(&Frame::new(sender, sequence, ring.tick, estimate));
    }
    ring.skip(SETTLED);
    ring
}

#[test]
fn diverged_agents_recover_by_restarting() {
    let mut ring = carried_off(&SETTINGS);
    let mut calm = settled(1, &SETTINGS, false);
    calm.skip(SETTLED);
    let (found, expected) = (ring.error_level(JUDGED), calm.error_level(JUDGED));
    println!("{found:.4?}, undisturbed {expected:.4?}");
    assert!(same_level(found, expected));
    for agent in &ring.agents {
        assert_eq!(agent.health.counters().restarts, 1, "one restart is enough");
        assert!(agent.health.network_in_use());
    }
}

#[test]
fn without_a_restart_they_never_recover() {
    // The fallback is disabled too: without the network no outer weights overflow, and feedback
    // alone recovers.
    let settings = HealthSettings { restart_after: None, fall_back: None, ..SETTINGS };
    let mut ring = carried_off(&settings);
    assert!(ring.error_level(JUDGED).iter().all(|&level| level > 1e20));
}

#[test]
fn every_event_is_counted_exactly() {
    let settings = HealthSettings { restart_after: None, fall_back: None, ..SETTINGS };
    let mut ring = settled(3, &settings, true);
    let before = ring.agents.iter().map(|agent| *agent.health.counters());
    // The start is harmless: the estimate starts and stays in the box.
    assert!(before.eq([HealthCounters::default(); 3]));
    let old = ring.agents[1].state.announcement(&ring.agents[1].params);
    ring.skip(100);
    for value in [f32::NAN, f32::INFINITY, f32::NAN] {
        ring.step(|agent, measurement| {
            if agent == 0 {
                *measurement = value;
            }
        });
    }
    ring.skip(20);
    for _ in 0..4 {
        let estimate = StateVector::repeat(1e20);
        ring.inject(&Frame::new(2, u32::MAX, ring.tick, estimate));
        ring.skip(1);
    }
    for _ in 0..5 {
        ring.inject(&old);
        ring.skip(1);
    }
    ring.tick += 6;
    ring.skip(1);
    let expected = |index: usize| HealthCounters {
        measurements_not_finite: if index == 0 { 3 } else { 0 },
        frames_implausible: if index == 2 { 0 } else { 4 },
        skipped_ticks: 6,
        ..HealthCounters::default()
    };
    for (index, agent) in ring.agents.iter().enumerate() {
        let counters = *agent.health.counters();
        // A copy that arrives together with a newer frame is refused by the inbox.
        let copies = counters.frames_stale + counters.frames_refused;
        assert_eq!(copies, if index == 1 { 0 } else { 5 });
        let (frames_stale, frames_refused) = (counters.frames_stale, counters.frames_refused);
        assert_eq!(
            counters,
            HealthCounters { frames_stale, frames_refused, ..expected(index) },
            "agent {index}"
        );
    }
}

/// Counts an agent's steps outside the box independently of the core, and predicts the fallback.
#[derive(Default)]
pub(crate) struct Ledger {
    pub(crate) outside: Vec<bool>,
    pub(crate) left_out: bool,
    since: usize,
}

impl Ledger {
    /// Returns whether the network is in use after one more step.
    pub(crate) fn enter(&mut self, outside: bool) -> bool {
        self.outside.push(outside);
        let steps = if self.left_out { 50 } else { 5 };
        let recent = &self.outside[self.since..];
        if recent.len() >= steps
            && recent[recent.len() - steps..].iter().all(|&outside| outside != self.left_out)
        {
            self.left_out = !self.left_out;
            self.since = self.outside.len();
        }
        !self.left_out
    }
}

fn falls_back_and_returns(seed: u64) -> Result<u32, TestCaseError> {
    let mut draw = Draw::new(seed);
    let mut ring = Ring::new(seed, &HealthSettings { restart_after: None, ..SETTINGS });
    let mut ledgers = [(); 3].map(|()| Ledger::default());
    let (mut offset, mut until) = (0.0, 0);
    for _ in 0..1_500 {
        if ring.tick >= until {
            offset = if draw.whole(0, 1) == 0 { 0.0 } else { draw.signed(60.0) };
            until = ring.tick + draw.whole(1, 120) as Tick;
        }
        ring.step(|agent, measurement| {
            if agent == 0 {
                *measurement += offset;
            }
        });
        for (agent, ledger) in ring.agents.iter().zip(&mut ledgers) {
            prop_assert_eq!(agent.refusal, None);
            let outside = !BOX.contains(agent.state.estimate().as_slice());
            prop_assert_eq!(agent.health.network_in_use(), ledger.enter(outside));
        }
    }
    let mut fall_backs = 0;
    for (agent, ledger) in ring.agents.iter().zip(&ledgers) {
        let counters = agent.health.counters();
        let outside = ledger.outside.iter().filter(|&&outside| outside).count();
        prop_assert_eq!(counters.outside_box as usize, outside);
        let returns = counters.fall_backs - u32::from(ledger.left_out);
        prop_assert_eq!(counters.returns, returns);
        fall_backs += counters.fall_backs;
    }
    Ok(fall_backs)
}

#[test]
fn fallbacks_occur() {
    assert!((0..8).map(|seed| falls_back_and_returns(seed).unwrap()).sum::<u32>() > 8);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn after_any_disturbance_errors_are_as_without_it(seed: u64, guarded: bool) {
        let (found, expected) = levels(seed, guarded);
        println!("{found:.4?}, undisturbed {expected:.4?}");
        prop_assert!(same_level(found, expected), "{:?}, undisturbed {:?}", found, expected);
    }

    #[test]
    fn the_same_disturbance_gives_the_same_bits(seed: u64, guarded: bool) {
        let run = || {
            let mut ring = settled(seed, &SETTINGS, guarded);
            disturb(&mut ring, &mut Draw::new(!seed));
            ring.skip(100);
            let counters: Vec<_> = ring.agents.iter().map(|a| *a.health.counters()).collect();
            (ring.bits(), counters)
        };
        prop_assert_eq!(run(), run());
    }

    #[test]
    fn fallback_and_return_follow_the_configured_steps(seed: u64) {
        falls_back_and_returns(seed)?;
    }

    #[test]
    fn frames_that_are_repeated_later_change_nothing(seed: u64) {
        let mut draw = Draw::new(!seed);
        let mut plain = Ring::new(seed, &SETTINGS);
        let mut repeated = Ring::new(seed, &SETTINGS);
        let mut said: Vec<Frame<3>> = Vec::new();
        for _ in 0..600 {
            plain.step(|_, _| ());
            repeated.step(|_, _| ());
            prop_assert_eq!(plain.bits(), repeated.bits());
            // At least two steps old: copies of frames still in transit are handled by the inbox.
            if !said.is_empty() {
                let oldest = said.len().saturating_sub(200);
                repeated.inject(&said[draw.whole(oldest, said.len() - 1)]);
            }
            said.extend(repeated.agents.iter().map(|a| a.state.announcement(&a.params)));
        }
        let dropped = repeated.agents.iter().map(|a| a.health.counters().frames_stale);
        prop_assert!(dropped.sum::<u32>() > 400);
    }
}

/// The released step equals the independently written steps of this test's ring: the same bits,
/// counters and frames in all cases.
#[test]
fn the_released_step_equals_the_one_written_here() {
    let mut total = HealthCounters::default().to_array();
    for seed in 0..8 {
        let (mut shipped, mut oracle) = (Ring::new(seed, &SETTINGS), Ring::new(seed, &SETTINGS));
        let mut draw = Draw::new(seed);
        for tick in 0..1_500 {
            // Every third block of a hundred steps is disturbed.
            let disturbed = tick / 100 % 3 == 2;
            if disturbed && draw.whole(0, 9) == 0 {
                let mut frame = huge_frame(&mut draw);
                if draw.whole(0, 1) == 0 {
                    // Plausible, but from an agent that is not a neighbour.
                    (frame.sender, frame.estimate) = (99, StateVector::zeros());
                }
                shipped.inject(&frame);
                oracle.inject(&frame);
            }
            let mut measured: [Option<f32>; 3] = [None; 3];
            for value in measured.iter_mut().filter(|_| disturbed) {
                *value = (draw.whole(0, 1) == 0).then(|| nonsense(&mut draw));
            }
            let disturb =
                |agent: usize, value: &mut f32| *value = measured[agent].unwrap_or(*value);
            shipped.step_as_shipped(disturb);
            oracle.step(disturb);
            assert_eq!(shipped.bits(), oracle.bits(), "seed {seed}, tick {tick}");
            assert_eq!(shipped.on_the_air(), oracle.on_the_air(), "seed {seed}, tick {tick}");
        }
        for (shipped, oracle) in shipped.agents.iter().zip(&oracle.agents) {
            assert_eq!(shipped.health.counters(), oracle.health.counters());
            for (sum, count) in total.iter_mut().zip(shipped.health.counters().to_array()) {
                *sum += count;
            }
        }
    }
    let seen = HealthCounters::from_array(total);
    for (count, what) in [
        (seen.frames_implausible, "implausible frames"),
        (seen.frames_refused, "refused frames"),
        (seen.measurements_not_finite, "measurements that are not finite"),
        (seen.diverged, "overflows"),
        (seen.fall_backs, "fall-backs"),
        (seen.restarts, "restarts"),
    ] {
        assert!(count > 0, "no {what}");
    }
}
