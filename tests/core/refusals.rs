//! Refusals change nothing: after every error of a step or an inbox, state and inbox are unchanged
//! bit for bit and continue like a copy that never saw the error.

use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, StepError};
use agent_core::observer::network::{Architecture, InnerNetwork, Layer};
use agent_core::wire::frame::{Frame, FrameError};
use proptest::prelude::*;

use crate::core::bits::{member_bits, output_bits};
use crate::core::random_network::{Draw, DrawnNetwork, Member, deliver, step_all};

/// Steps before and after the errors.
const STEPS: u64 = 4;

/// Returns a network that has run for a while, with a frame of every agent pending everywhere.
fn warm<'a, const N: usize>(drawn: &'a DrawnNetwork<N>, draw: &mut Draw) -> Vec<Member<'a, N>> {
    let mut members = drawn.members();
    for tick in 0..STEPS {
        let (measurements, order) = (draw.measurements(drawn), draw.order(members.len()));
        step_all(&mut members, &order, tick, &measurements);
    }
    let mut frames = Vec::new();
    for member in &mut members {
        member.inbox.clear();
        frames.push((member.params.id(), member.state.announcement(&member.params).encode()));
    }
    deliver(&mut members, &frames);
    members
}

/// Checks that `member` and a copy that saw no error take the same further steps.
fn go_on_alike<const N: usize>(
    mut member: Member<'_, N>,
    mut untouched: Member<'_, N>,
    outputs: usize,
    draw: &mut Draw,
) -> Result<(), TestCaseError> {
    for tick in STEPS..2 * STEPS {
        let measurement = draw.signed_many(outputs, 1.0);
        let found = member.step(tick, &measurement);
        let expected = untouched.step(tick, &measurement);
        prop_assert_eq!(output_bits(&found), output_bits(&expected));
        prop_assert_eq!(member_bits(&member), member_bits(&untouched));
    }
    Ok(())
}

/// Whether both are the same variant.
fn same_kind(found: StepError, expected: StepError) -> bool {
    std::mem::discriminant(&found) == std::mem::discriminant(&expected)
}

/// Provokes every error of a step, one after the other, on every agent of a network.
fn refused_steps<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let drawn = draw.network::<N>();
    // The same agents with a gain so large that every single-precision estimate overflows.
    let mut violent = drawn.clone();
    violent.gain *= 1e33 / violent.gain.amax();
    for (index, member) in warm(&drawn, &mut draw).into_iter().enumerate() {
        let untouched = member.clone();
        let mut member = member;
        let (before, waiting) = (member_bits(&member), member.inbox.len());
        let outputs = drawn.agents[index].output_rows.len();
        let good = draw.signed_many(outputs, drawn.magnitude);
        let place = draw.whole(0, outputs - 1);
        let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY].map(|value| {
            let mut measurement = good.clone();
            measurement[place] = value;
            measurement
        });
        let huge = vec![f32::MAX; outputs];
        let with_width = |inputs: usize, width: usize| {
            let layer = Layer { width: width as u8, ..drawn.agents[index].layers[0] };
            let architecture = Architecture::new(inputs, &[layer]).unwrap();
            let parameters = vec![0.5; architecture.parameter_count()];
            InnerNetwork::new(architecture, parameters).unwrap()
        };
        let features = drawn.agents[index].features();
        let (wide, deep) = (with_width(N, features + 1), with_width(N % 12 + 1, features));
        let violent = violent.params(index);

        let own = Some(&member.inner_network);
        let calm = &member.params;
        type Attempt<'t, const N: usize> =
            (&'t AgentParams<'t, N>, Option<&'t InnerNetwork<Vec<f32>>>, u64, &'t [f32], StepError);
        let tick = StepError::Tick { last: Some(0), found: 0 };
        let not_finite = StepError::MeasurementNotFinite { output: 0 };
        let (expected, found) = (0, 0);
        let attempts: [Attempt<'_, N>; 12] = [
            (calm, own, STEPS - 1, &good, tick),
            (calm, None, 0, &good, tick),
            (calm, own, STEPS, &good[1..], StepError::Outputs { expected, found }),
            (calm, None, STEPS, &[], StepError::Outputs { expected, found }),
            (calm, own, STEPS, &bad[0], not_finite),
            (calm, None, STEPS, &bad[1], not_finite),
            (calm, own, STEPS, &bad[2], not_finite),
            (calm, Some(&wide), STEPS, &good, StepError::Features { expected, found }),
            (calm, Some(&deep), STEPS, &good, StepError::NetworkInputs { expected, found }),
            // The outer weights overflow; the estimate; the estimate after the weights were
            // planned.
            (calm, own, STEPS, &huge, StepError::Diverged),
            (&violent, None, STEPS, &huge, StepError::Diverged),
            (
                &violent,
                own,
                STEPS,
                &good.iter().map(|y| y + 1e12).collect::<Vec<_>>(),
                StepError::Diverged,
            ),
        ];
        let mut state = member.state.clone();
        let mut inbox = member.inbox.clone();
        for (number, (params, network, tick, measurement, expected)) in
            attempts.into_iter().enumerate()
        {
            let error = state.step(params, network, tick, measurement, &mut inbox).unwrap_err();
            prop_assert!(same_kind(error, expected), "attempt {}: {:?}", number, error);
            if let StepError::MeasurementNotFinite { output } = error {
                prop_assert_eq!(output, place);
            }
            prop_assert_eq!(inbox.len(), waiting);
        }
        // An inbox for a different number of neighbours is unchanged too.
        let mut other = Inbox::new(vec![None; calm.neighbours().len() + 1]);
        let frame = Frame::<N>::new(calm.neighbours()[0].id, 9, 9, draw.vector(1.0));
        other.accept(calm.neighbours(), &frame.encode()).unwrap();
        let error = state.step(calm, own, STEPS, &good, &mut other).unwrap_err();
        let places = calm.neighbours().len();
        prop_assert_eq!(error, StepError::Neighbours { expected: places, found: places + 1 });
        prop_assert_eq!(other.len(), 1);

        (member.state, member.inbox) = (state, inbox);
        prop_assert_eq!(member_bits(&member), before);
        go_on_alike(member, untouched, outputs, &mut draw)?;
    }
    Ok(())
}

/// A frame that makes the step diverge stays in the inbox until it is discarded.
fn divergence_by_a_frame<const N: usize>(seed: u64) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let mut drawn = draw.network::<N>();
    drawn.gain *= 1e6 / drawn.step_size;
    let mut member = drawn.silent_members().swap_remove(0);
    let before = member_bits(&member);
    let neighbours = member.params.neighbours();
    let frame = Frame::<N>::new(neighbours[0].id, 0, 0, agent_core::StateVector::repeat(f32::MAX));
    member.inbox.accept(neighbours, &frame.encode()).unwrap();
    let measurement = vec![0.0; member.params.outputs()];
    for _ in 0..2 {
        let found = member.state.step(
            &member.params,
            Some(&member.inner_network),
            0,
            &measurement,
            &mut member.inbox,
        );
        prop_assert_eq!(found, Err(StepError::Diverged));
        prop_assert_eq!(member.inbox.len(), 1);
        prop_assert_eq!(&member_bits(&member), &before);
    }
    Ok(())
}

/// Provokes every refusal of an inbox, for every agent of a network.
fn refused_frames<const N: usize>(seed: u64, noise: &[u8]) -> Result<(), TestCaseError> {
    let mut draw = Draw::new(seed);
    let drawn = draw.network::<N>();
    for (index, member) in warm(&drawn, &mut draw).into_iter().enumerate() {
        let mut member = member;
        let neighbours = member.params.neighbours();
        // Slots for the last neighbour only, so that frames are refused for their contents.
        member.inbox.clear();
        for neighbour in &neighbours[..neighbours.len() - 1] {
            let frame = Frame::<N>::new(neighbour.id, 3, 3, draw.vector(1.0));
            member.inbox.accept(neighbours, &frame.encode()).unwrap();
        }
        let untouched = member.clone();
        let (before, waiting) = (member_bits(&member), member.inbox.len());

        let sender = neighbours[neighbours.len() - 1].id;
        let valid = Frame::<N>::new(sender, 7, STEPS, draw.vector(1.0));
        let mut refused: Vec<Vec<u8>> = vec![noise.to_vec(), Vec::new()];
        let mut bytes = valid.encode();
        let bit = draw.whole(0, 8 * bytes.len() - 1);
        bytes[bit / 8] ^= 1 << (bit % 8);
        refused.push(bytes.to_vec());
        let bytes = valid.encode();
        refused.push(bytes[..draw.whole(0, bytes.len() - 1)].to_vec());
        refused.push([&bytes[..], noise, &[0]].concat());
        for component in [f32::NAN, f32::INFINITY] {
            let mut frame = valid;
            frame.estimate[draw.whole(0, N - 1)] = component;
            refused.push(frame.encode().to_vec());
        }
        let stranger = (0..).find(|id| neighbours.iter().all(|n| n.id != *id)).unwrap();
        let unknown = Frame { sender: stranger, ..valid };
        refused.push(unknown.encode().to_vec());
        let own = Frame { sender: member.params.id(), ..valid };
        refused.push(own.encode().to_vec());
        if neighbours.len() > 1 {
            // As old as the pending one, or older.
            for sequence in [3, 2] {
                let again = Frame { sender: neighbours[0].id, sequence, tick: 3, ..valid };
                refused.push(again.encode().to_vec());
            }
        }
        let longer = Frame::<4>::new(sender, 7, STEPS, draw.vector(1.0));
        refused.push(longer.encode().to_vec());

        for bytes in &refused {
            prop_assert!(member.inbox.accept(neighbours, bytes).is_err(), "{:?}", bytes);
            prop_assert_eq!(member.inbox.len(), waiting);
        }
        let twice = [0, 1].map(|_| {
            let mut inbox = member.inbox.clone();
            inbox.accept(neighbours, &bytes).unwrap();
            (inbox.len(), inbox.accept(neighbours, &bytes), inbox.len())
        });
        let duplicate = Err(FrameError::DuplicateSender { sender });
        prop_assert_eq!(twice, [(waiting + 1, duplicate, waiting + 1); 2]);
        prop_assert_eq!(member_bits(&member), before);
        go_on_alike(member, untouched, drawn.agents[index].output_rows.len(), &mut draw)?;
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_refused_step_changes_nothing(seed: u64) {
        refused_steps::<1>(seed)?;
        refused_steps::<3>(seed)?;
        refused_steps::<12>(seed)?;
    }

    #[test]
    fn a_frame_that_makes_a_step_diverge_changes_nothing(seed: u64) {
        divergence_by_a_frame::<1>(seed)?;
        divergence_by_a_frame::<3>(seed)?;
        divergence_by_a_frame::<12>(seed)?;
    }

    #[test]
    fn a_refused_frame_changes_nothing(
        seed: u64, noise in prop::collection::vec(any::<u8>(), 0..100),
    ) {
        refused_frames::<1>(seed, &noise)?;
        refused_frames::<3>(seed, &noise)?;
        refused_frames::<12>(seed, &noise)?;
    }
}
