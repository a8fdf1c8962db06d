//! An agent as on a node, with every kind of fault.

use agent_core::health::{HealthCounters, WatchedStep};
use agent_core::observer::network::Scratch;
use agent_core::wire::frame::{Frame, FrameBytes};

use crate::Unusable;
use crate::digest::Digest;
use crate::draw::{scaled, triangle};
use crate::meter::{Figure, Figures, Meter};
use crate::node::{N, Node, ParamBuffers};
use crate::package;

/// Number of steps.
const STEPS: u32 = 3_000;

/// The measurement is NaN.
const NOT_A_NUMBER: core::ops::Range<u32> = 700..703;
/// The measurement is an outlier, which leads outside the trained box and back.
const OUTLIER: core::ops::Range<u32> = 1_100..1_110;
/// The step would overflow with this measurement.
const OVERFLOW: core::ops::Range<u32> = 1_600..1_607;
/// Ticks without a step.
const LATE: core::ops::Range<u32> = 2_000..2_009;
/// The estimate is implausible.
const IMPLAUSIBLE: core::ops::Range<u32> = 2_400..2_401;

/// From here on the outer weights are so large that the projection acts on them.
const LARGE_WEIGHTS: u32 = 2_700;
/// Scales the package's outer weights, whose norm is 11.6, above the 19 where that starts.
const ENLARGEMENT: f32 = 1.6875;

/// Returns the measurement at `tick`.
fn measurement(tick: u32) -> f32 {
    let y = scaled(triangle(tick, 1_500), 10);
    if NOT_A_NUMBER.contains(&tick) {
        f32::NAN
    } else if OUTLIER.contains(&tick) {
        y + 64.0
    } else if OVERFLOW.contains(&tick) {
        f32::MAX
    } else if IMPLAUSIBLE.contains(&tick) {
        1e6
    } else {
        y
    }
}

/// Returns the broadcast of neighbour `id` at `tick`, if any: both have their own pace.
fn frame(id: u32, tick: u32) -> Option<FrameBytes> {
    let period = 7 + 6 * id;
    let sequence = tick / period;
    if !tick.is_multiple_of(period) {
        return None;
    }
    let phase = tick + 300 * id;
    let estimate = [
        scaled(triangle(phase, 1_500), 10),
        scaled(triangle(phase + 1_500, 2_000), 9),
        scaled(triangle(phase, 500), 11),
    ];
    let mut frame = Frame::new(id, sequence, tick.into(), estimate.into());
    match sequence % 40 {
        // From an unknown sender, implausible, and from the past.
        17 => frame.sender = 99,
        23 => frame.estimate[1] = 1e30,
        31 => (frame.sequence, frame.tick) = (0, 0),
        _ => {}
    }
    let mut bytes = frame.encode();
    if let (37, Some(byte)) = (sequence % 40, bytes.get_mut(5)) {
        *byte ^= 0x10;
    }
    Some(bytes)
}

#[inline(never)]
pub(crate) fn digest(meter: &mut impl Meter, figures: &mut Figures) -> Result<u64, Unusable> {
    let mut digest = Digest::NEW;
    let mut places = ParamBuffers::EMPTY;
    let mut node = Node::new(&mut places, &mut Scratch::NEW.clone())?;
    let mut broadcast = FrameBytes::new();
    digest.bytes(&node.state.announcement(&node.params).encode());
    for tick in (0..STEPS).filter(|tick| !LATE.contains(tick)) {
        for id in [2, 3] {
            let Some(bytes) = frame(id, tick) else { continue };
            let (accepted, instructions) = meter.count(|| node.receive(&bytes));
            digest.bytes(&bytes);
            digest.number(accepted.is_ok().into());
            if accepted.is_ok() {
                figures.add(Figure::Frame, instructions);
            }
        }
        if tick == LARGE_WEIGHTS {
            node.enlarge_outer_weights(ENLARGEMENT)?;
        }
        let measured = [measurement(tick)];
        let with_network = node.health.network_in_use();
        let (step, instructions) =
            meter.count(|| node.step(package::bytes(), tick.into(), &measured, &mut broadcast));
        if matches!(step, WatchedStep::Taken(_)) && with_network {
            let figure = if broadcast.is_empty() { Figure::Step } else { Figure::Broadcast };
            figures.add(figure, instructions);
        }
        add(&mut digest, &node, &step, &broadcast);
    }
    if let Some(missing) = what_did_not_happen(node.health.counters()) {
        return Err(Unusable { what: missing });
    }
    Ok(digest.finish())
}

/// A fault that never occurs is not tested: returns the first one missing.
fn what_did_not_happen(counters: &HealthCounters) -> Option<&'static str> {
    let HealthCounters {
        outside_box,
        implausible,
        diverged,
        projection_active,
        measurements_not_finite,
        skipped_ticks,
        frames_implausible,
        frames_refused,
        frames_stale,
        fall_backs,
        returns,
        restarts,
        ..
    } = *counters;
    [
        (outside_box, "the run never leaves the trained box"),
        (implausible, "the run has no implausible estimate"),
        (projection_active, "the projection never acts"),
        (diverged, "the run has no divergence"),
        (measurements_not_finite, "the run has no measurement that is not finite"),
        (skipped_ticks, "the run has no late step"),
        (frames_implausible, "the run has no implausible frame"),
        (frames_refused, "the run has no refused frame"),
        (frames_stale, "the run has no stale frame"),
        (fall_backs, "the run never falls back"),
        (returns, "the run never returns to the network"),
        (restarts, "the run has no restart"),
    ]
    .into_iter()
    .find_map(|(count, missing)| (count == 0).then_some(missing))
}

/// Adds the visible state of the node.
fn add(digest: &mut Digest, node: &Node<'_>, step: &WatchedStep<N>, broadcast: &[u8]) {
    digest.number(match step {
        WatchedStep::Taken(_) => 0,
        WatchedStep::Refused(_) => 1,
        WatchedStep::Restarted(_) => 2,
    });
    let state = &node.state;
    digest.floats(state.estimate());
    digest.floats(state.outer_weights().rows().iter().flatten());
    digest.number(state.outer_weights().norm_squared().to_bits());
    digest.floats(state.consensus_term());
    digest.floats(state.output_error(&node.params));
    digest.number(state.own_hold().sequence());
    digest.number(state.stale_frames());
    let HealthCounters {
        outside_box,
        implausible,
        projection_active,
        diverged,
        measurements_not_finite,
        skipped_ticks,
        frames_implausible,
        frames_refused,
        frames_stale,
        fall_backs,
        returns,
        restarts,
        ..
    } = *node.health.counters();
    for counter in [
        outside_box,
        implausible,
        projection_active,
        diverged,
        measurements_not_finite,
        skipped_ticks,
        frames_implausible,
        frames_refused,
        frames_stale,
        fall_backs,
        returns,
        restarts,
    ] {
        digest.number(counter);
    }
    digest.bytes(broadcast);
}
