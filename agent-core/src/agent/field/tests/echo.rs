//! What agents do when a neighbour's frame shows a loss.

use super::*;

const REPEAT: Tick = 40;
const DELAY: Tick = 5;

/// Agent 1, the root of direction 0, after its first broadcast at tick 1, with its neighbours at rest.
fn relay() -> Member {
    let exchange =
        ExchangeParams { repeat: REPEAT as u32, delay: DELAY as u32, ..ExchangeParams::PAPER };
    let mut member = Member::new(0, exchange);
    member.network = None;
    member.set(&field(0, options(HoldKind::ZeroOrder)));
    member
}

/// Returns the ticks of broadcasts if agent 2 shows this estimate from some arrival on, every `period` steps.
/// Each of its frames takes [`DELAY`].
fn broadcasts(estimate: [f32; 3], first: Tick, period: Tick) -> Vec<Tick> {
    let mut member = relay();
    for tick in 0..300 {
        if tick >= first && (tick - first).is_multiple_of(period) {
            let sequence = ((tick - first) / period) as u32;
            member.hear(&sample(2, sequence, tick - DELAY, estimate));
        }
        member.step(tick, Some(0.3));
    }
    member.sent.iter().map(|&(tick, _)| tick).collect()
}

/// The frame that lacks the sample arrives in a step, and the answer belongs to the next tick. Broadcast at 1,
/// and not repeated, since it was not an event.
const FIRST: Tick = 1;

#[test]
fn a_neighbour_that_lacks_the_sample_gets_it_again() {
    // The radius is 0.02.
    for (x, lacks) in [(0.3, false), (0.309, false), (0.311, true), (0.289, true)] {
        let sent = broadcasts([x, 0.3, 0.3], 100, 500);
        let expected = if lacks { vec![FIRST, 101] } else { vec![FIRST] };
        assert_eq!(sent, expected, "{x}");
    }
}

#[test]
fn a_parent_cannot_lack_what_the_agent_has_from_it() {
    // Agent 2 is the root of direction 1, and agent 1 does not pass on such a small move.
    assert_eq!(broadcasts([0.3, 0.315, 0.3], 100, 500), [FIRST]);
    // Agent 1 relays direction 2 to it.
    assert_eq!(broadcasts([0.3, 0.3, 0.315], 100, 500), [FIRST, 101]);
}

#[test]
fn answers_are_as_far_apart_as_repetitions() {
    let sent = broadcasts([0.35, 0.3, 0.3], 10, 1);
    let apart = sent.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(sent.len() > 5 && apart.clone().all(|ticks| ticks > REPEAT), "{sent:?}");
}

#[test]
fn a_frame_from_before_the_sample_says_nothing() {
    for (age, answers) in [(95, false), (94, false), (93, true)] {
        let mut member = relay();
        // The neighbour's clock is known.
        let mut sent = vec![];
        for tick in 0..110 {
            match tick {
                0 => member.hear(&sample(2, 0, 0, [0.3; 3])),
                100 => member.hear(&sample(2, 1, 100 + DELAY - age, [0.35, 0.3, 0.3])),
                _ => {}
            }
            sent.extend(member.step(tick, Some(0.3)).map(|_| tick + 1));
        }
        assert_eq!(sent.contains(&101), answers, "{age}: {sent:?}");
    }
}

#[test]
fn without_repetitions_nothing_is_answered() {
    let mut member = relay();
    member.params = params(0, ExchangeParams { delay: 5, ..ExchangeParams::PAPER });
    for tick in 0..200 {
        if tick == 100 {
            member.hear(&sample(2, 0, 95, [0.35, 0.3, 0.3]));
        }
        member.step(tick, Some(0.3));
    }
    assert_eq!(member.sent.len(), 1);
}
