//! Tests of announcements, parameters and disturbance models on their own.

extern crate std;

use std::vec::Vec;

use proptest::prelude::*;

use super::disturbance::Model;
use super::*;
use crate::math::half::{from_half, to_half};
use crate::math::numeric::all_finite;
use crate::wire::frame::{Frame, FrameError};

/// A finite number of any size.
fn finite() -> impl Strategy<Value = f32> {
    any::<u32>().prop_map(|bits| {
        let number = f32::from_bits(bits);
        if number.is_finite() { number } else { f32::from_bits(bits & !(1 << 30)) }
    })
}

/// A number that is a half, so that rounding does not change it.
fn half() -> impl Strategy<Value = f32> {
    any::<u16>()
        .prop_map(|bits| from_half(if bits & 0x7c00 == 0x7c00 { bits ^ 0x4000 } else { bits }))
}

/// An announcement of any kind with the estimate that goes with it, as a sender would make it: what is
/// not announced is 0.
fn announcement<const N: usize>() -> impl Strategy<Value = (StateVector<N>, Announced<N>)> {
    let head = (any::<u16>(), 0..3usize, any::<bool>(), any::<bool>(), any::<u16>());
    head.prop_flat_map(|(digest, hold, has_harmonics, is_half, directions)| {
        let numbers = match is_half {
            true => prop::collection::vec(half().boxed(), 5 * N),
            false => prop::collection::vec(finite().boxed(), 5 * N),
        };
        numbers.prop_map(move |numbers| {
            let hold = HoldKind::ALL[hold];
            let vector =
                |from: usize| StateVector::<N>::from_column_slice(&numbers[from..from + N]);
            let mut announced = Announced::<N> {
                digest,
                hold,
                has_harmonics,
                is_half,
                directions: directions & ((1 << N) - 1),
                rate: if hold == HoldKind::Rate { vector(N) } else { zeros() },
                disturbances: [Disturbance::NONE; N],
            };
            for c in 0..N {
                if announced.announces(c) {
                    let bias = numbers[2 * N + c];
                    let [cosine, sine] = match has_harmonics {
                        true => [numbers[3 * N + c], numbers[4 * N + c]],
                        false => [0.0; 2],
                    };
                    announced.disturbances[c] = Disturbance { bias, cosine, sine };
                }
            }
            (vector(0), announced)
        })
    })
}

fn length<const N: usize>(announced: &Announced<N>) -> usize {
    let rates = if announced.hold == HoldKind::Rate { N } else { 0 };
    let directions = announced.directions.count_ones() as usize;
    Announced::<N>::words_for(rates, directions, announced.has_harmonics, announced.is_half)
}

/// Bits of everything, so that the sign of zero counts.
fn bits<const N: usize>((estimate, announced): &(StateVector<N>, Announced<N>)) -> Vec<u32> {
    let disturbances = announced.disturbances.iter().flat_map(|d| [d.bias, d.cosine, d.sine]);
    let numbers =
        estimate.iter().copied().chain(announced.rate.iter().copied()).chain(disturbances);
    numbers.map(f32::to_bits).collect()
}

fn survives<const N: usize>(sent: &(StateVector<N>, Announced<N>)) -> Result<(), TestCaseError> {
    let (estimate, announced) = sent;
    let words = announced.words(estimate);
    if length(announced) > WORDS_MAX {
        prop_assert!(words.is_empty());
        return Ok(());
    }
    prop_assert_eq!(words.len(), length(announced));
    let received = Announced::<N>::from_words(&words);
    prop_assert_eq!(received.as_ref(), Some(sent));
    prop_assert_eq!(received.map(|received| bits(&received)), Some(bits(sent)));
    let frame = Frame { announced: Some(*announced), ..Frame::new(7, 3, 900, *estimate) };
    prop_assert_eq!(Frame::decode(&frame.encode()), Ok(frame));
    Ok(())
}

proptest! {
    #[test]
    fn every_announcement_survives_its_words(
        one in announcement::<1>(), two in announcement::<2>(), three in announcement::<3>(),
        four in announcement::<4>(), five in announcement::<5>(), six in announcement::<6>(),
        seven in announcement::<7>(), eight in announcement::<8>(), nine in announcement::<9>(),
        ten in announcement::<10>(), eleven in announcement::<11>(), twelve in announcement::<12>(),
    ) {
        survives(&one)?;
        survives(&two)?;
        survives(&three)?;
        survives(&four)?;
        survives(&five)?;
        survives(&six)?;
        survives(&seven)?;
        survives(&eight)?;
        survives(&nine)?;
        survives(&ten)?;
        survives(&eleven)?;
        survives(&twelve)?;
    }

    /// And each announcement has one byte string.
    #[test]
    fn any_words_are_an_announcement_or_nothing(
        head: u32, words in prop::collection::vec(any::<[u8; 4]>(), 0..WORDS_MAX),
    ) {
        let words = [&[head.to_le_bytes()], &words[..]].concat();
        check_words::<1>(&words)?;
        check_words::<3>(&words)?;
        check_words::<12>(&words)?;
        // With the length that the head asks for, most are announcements.
        let directions = head >> 16 & 7;
        let (is_half, has_harmonics) = (head >> 31 == 1, head >> 30 & 1 == 1);
        let rates = if head >> 28 & 3 == 1 { 3 } else { 0 };
        let count = directions.count_ones() as usize;
        let length = Announced::<3>::words_for(rates, count, has_harmonics, is_half);
        let mut words = words;
        words.resize(length, [9, 30, 2, 40]);
        words[0] = (head & 0xf007_ffff).to_le_bytes();
        check_words::<3>(&words)?;
    }

    /// Rounding an announcement gives what its receiver gets, and rounding again changes nothing.
    #[test]
    fn rounding_gives_what_a_frame_carries(
        (estimate, announced) in announcement::<3>(), numbers in prop::array::uniform6(finite()),
    ) {
        let mut sent = announced;
        sent.is_half = true;
        let mut sample = estimate;
        sample[1] = numbers[0];
        if sent.hold == HoldKind::Rate {
            sent.rate[2] = numbers[1];
        }
        if sent.announces(0) {
            sent.disturbances[0].bias = numbers[2];
        }
        sent.round(&mut sample);
        let received = Announced::<3>::from_words(&sent.words(&sample));
        prop_assert_eq!(received.as_ref(), Some(&(sample, sent)));
        let (mut again, mut once_more) = (sample, sent);
        once_more.round(&mut again);
        prop_assert_eq!((again, once_more), (sample, sent));
    }

    #[test]
    fn the_disturbance_stays_within_the_clip(
        start in prop::array::uniform3(-2.0..2.0_f32), angle in 0.0..0.1_f64,
        gains in prop::array::uniform3(0.0..1e4_f32),
        impulses in prop::collection::vec(-1.0..1.0_f32, 1..200),
    ) {
        let model = Model {
            bias_gain: gains[0],
            cosine_gain: gains[1],
            sine_gain: gains[2],
            clip: 2.0,
            ..turning(angle)
        };
        let [bias, cosine, sine] = start;
        let mut disturbance = Disturbance { bias, cosine, sine };
        for impulse in impulses {
            disturbance = model.corrected(&disturbance, impulse);
            prop_assert!(disturbance.is_finite() && disturbance.bias.abs() <= 2.0);
            prop_assert!(model.clipped(&disturbance).abs() <= 2.0);
        }
    }
}

fn check_words<const N: usize>(words: &[[u8; 4]]) -> Result<(), TestCaseError> {
    if let Some((estimate, announced)) = Announced::<N>::from_words(words) {
        prop_assert!(all_finite(&estimate) && all_finite(&announced.rate));
        prop_assert!(announced.disturbances.iter().all(Disturbance::is_finite));
        for c in 0..N {
            let nothing = announced.disturbance(c).is_none();
            prop_assert_eq!(nothing, announced.directions >> c & 1 == 0);
            prop_assert!(!nothing || announced.disturbances[c] == Disturbance::NONE);
        }
        prop_assert_eq!(&announced.words(&estimate)[..], words);
    }
    Ok(())
}

/// A model that turns by `angle` in a step.
fn turning(angle: f64) -> Model {
    Model {
        rotation_cosine: libm::cos(angle) as f32,
        rotation_sine: libm::sin(angle) as f32,
        clip: 10.0,
        ..Model::NONE
    }
}

#[test]
fn the_words_of_an_announcement_are_those_of_the_documentation() {
    let announced = Announced::<2> {
        digest: 0xabcd,
        hold: HoldKind::Rate,
        has_harmonics: true,
        is_half: false,
        directions: 0b10,
        rate: [3.0, 4.0].into(),
        disturbances: [Disturbance::NONE, Disturbance { bias: 5.0, cosine: 6.0, sine: 7.0 }],
    };
    let estimate = [1.0, 2.0].into();
    let head: u32 = 0xabcd | 0b10 << 16 | 1 << 28 | 1 << 30;
    let numbers = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0_f32].map(f32::to_le_bytes);
    assert_eq!(announced.words(&estimate)[..], [&[head.to_le_bytes()], &numbers[..]].concat());
    let half = Announced { is_half: true, ..announced };
    let pair = |a: f32, b: f32| (u32::from(to_half(a)) | u32::from(to_half(b)) << 16).to_le_bytes();
    let words = [
        (head | 1 << 31).to_le_bytes(),
        pair(1.0, 2.0),
        pair(3.0, 4.0),
        pair(5.0, 6.0),
        pair(7.0, 0.0),
    ];
    assert_eq!(half.words(&estimate), words);
    // The half that is left over must be 0.
    let mut other = words;
    other[4] = pair(7.0, 1.0);
    assert_eq!(Announced::<2>::from_words(&other), None);
    // A hold, a direction or a length that there is not.
    for head in [head | 3 << 28, head | 0b100 << 16, head & !(1 << 30), head & !(1 << 28)] {
        let words = [&[head.to_le_bytes()], &numbers[..]].concat();
        assert_eq!(Announced::<2>::from_words(&words), None, "{head:x}");
    }
    for place in 0..numbers.len() {
        for number in [f32::NAN, f32::INFINITY] {
            let mut numbers = numbers;
            numbers[place] = number.to_le_bytes();
            let words = [&[head.to_le_bytes()], &numbers[..]].concat();
            assert_eq!(Announced::<2>::from_words(&words), None);
        }
    }
    assert_eq!(Announced::<2>::from_words(&[]), None);
}

#[test]
fn a_field_frame_has_kind_1() {
    let announced = Announced::<1> { digest: 5, ..Announced::NONE };
    let frame = Frame { announced: Some(announced), ..Frame::new(2, 7, 300, [1.5].into()) };
    let bytes = frame.encode();
    let body = [1, 2, 7, 0xac, 0x02, 1, 2, 5, 0, 0, 0, 0, 0, 0xc0, 0x3f];
    assert_eq!(&bytes[..body.len()], body);
    // Words that are not an announcement are refused, as is a different dimension.
    assert_eq!(Frame::<2>::decode(&bytes), Err(FrameError::Malformed));
    let empty = Frame { announced: Some(Announced { directions: 2, ..announced }), ..frame };
    assert_eq!(Frame::<1>::decode(&empty.encode()), Err(FrameError::Malformed));
}

/// Parameters for two coordinates `T = [[2, 0], [1, 4]]`.
fn params() -> FieldParams<2> {
    let model = Model { bias_gain: 3.0, cosine_gain: -2.0, sine_gain: 1.0, ..turning(0.01) };
    let root = Direction {
        output: Some(0),
        is_announced: true,
        scale: -0.5,
        root_gain: 100.0,
        tree_gain: 200.0,
        radius: 0.25,
        model,
        ..Direction::NONE
    };
    let follower = Direction { output: None, parent: Some(1), spare: Some(0), ..root };
    FieldParams {
        options: Options {
            digest: 0xbeef,
            hold: HoldKind::Model,
            coupling: Coupling::Trees,
            uses_network: true,
            adapts: false,
            has_harmonics: true,
            is_half: false,
            timeout: 250,
            bias_kept: 0.999,
            relay_share: 0.9,
        },
        transform: SMatrix::<f32, 2, 2>::new(2.0, 0.0, 1.0, 4.0),
        inverse: SMatrix::<f32, 2, 2>::new(0.5, 0.0, -0.125, 0.25),
        low: [-3.0, -4.0].into(),
        high: [3.0, 4.0].into(),
        directions: [root, follower],
    }
}

/// Returns the parameters as in a package.
pub(crate) fn words<const N: usize>(params: &FieldParams<N>) -> Vec<f32> {
    let rows = |matrix: &SMatrix<f32, N, N>| matrix.transpose().as_slice().to_vec();
    let mut words = params.options.words().to_vec();
    words.extend(rows(&params.transform));
    words.extend(rows(&params.inverse));
    words.extend(params.low.iter());
    words.extend(params.high.iter());
    words.extend(params.directions.iter().flat_map(Direction::words));
    words
}

fn decoded(words: &[f32]) -> Result<FieldParams<2>, ParameterError> {
    FieldParams::from_words(FieldWords(words))
}

#[test]
fn parameters_survive_their_words() {
    let params = params();
    let all = words(&params);
    assert_eq!(all.len(), words_length(2));
    assert_eq!(decoded(&all), Ok(params.clone()));
    assert_eq!(params.validate(1, 2, 1e-3), Ok(()));
    for hold in HoldKind::ALL {
        for coupling in Coupling::ALL {
            for flags in 0..16_u8 {
                let is = |bit: u8| flags >> bit & 1 == 1;
                let options = Options {
                    hold,
                    coupling,
                    uses_network: is(0),
                    adapts: is(1),
                    has_harmonics: is(2),
                    is_half: is(3),
                    digest: u16::MAX,
                    timeout: u32::MAX,
                    ..params.options
                };
                let params = FieldParams { options, ..params.clone() };
                assert_eq!(decoded(&words(&params)), Ok(params));
            }
        }
    }
}

#[test]
fn words_that_are_no_parameters_are_refused() {
    let all = words(&params());
    for length in (0..all.len()).chain([all.len() + 1]) {
        let mut some = all.clone();
        some.resize(length, 0.0);
        let expected = words_length(2);
        let length = ParameterError::Length { parameter: "field", expected, found: length };
        assert_eq!(decoded(&some), Err(length));
    }
    let with = |place: usize, bits: u32| {
        let mut words = all.clone();
        words[place] = f32::from_bits(bits);
        decoded(&words)
    };
    let roles = 5 + 8 + 4;
    for (place, bits) in [
        (0, 3),           // hold
        (0, 3 << 8),      // coupling
        (0, 1 << 20),     // flag
        (0, 1 << 24),     // not used
        (1, 1 << 16),     // digest
        (roles, 2 << 24), // whether announced
    ] {
        assert!(matches!(with(place, bits), Err(ParameterError::Length { .. })), "{place}");
    }
    // Every number; the others are integers.
    let integers = [0, 1, 2, roles, roles + 11];
    for place in 0..all.len() {
        for number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let result = with(place, number.to_bits());
            if !integers.contains(&place) {
                assert!(matches!(result, Err(ParameterError::OutOfRange { .. })), "{place}");
            }
        }
    }
}

#[test]
fn every_parameter_out_of_range_is_refused() {
    type Change = fn(&mut FieldParams<2>);
    let refused: [(Change, &str); 24] = [
        (|p| p.options.bias_kept = -0.1, "a kept bias from 0 to 1"),
        (|p| p.options.bias_kept = 1.1, "a kept bias from 0 to 1"),
        (|p| p.options.relay_share = 0.0, "a share up to 1"),
        (|p| p.options.relay_share = 1.1, "a share up to 1"),
        (|p| p.options.relay_share = f32::NAN, "a share up to 1"),
        (|p| p.low[1] = 4.5, "limits in order"),
        (|p| p.high[0] = f32::NAN, "limits in order"),
        (|p| p.directions[0].root_gain = -1.0, "a gain below 2 / step_size"),
        (|p| p.directions[1].root_gain = 2000.0, "a gain below 2 / step_size"),
        (|p| p.directions[0].tree_gain = f32::INFINITY, "a gain below 2 / step_size"),
        (|p| p.directions[1].tree_gain = f32::NAN, "a gain below 2 / step_size"),
        (|p| p.directions[0].radius = 0.0, "a radius above 0"),
        (|p| p.directions[1].radius = f32::NAN, "a radius above 0"),
        (|p| p.directions[0].model.clip = -1.0, "a clip and a gain of 0 or above"),
        (|p| p.directions[0].model.clip = f32::NAN, "a clip and a gain of 0 or above"),
        (|p| p.directions[1].model.bias_gain = -1.0, "a clip and a gain of 0 or above"),
        (|p| p.directions[0].model.rotation_cosine = 1.01, "a rotation"),
        (|p| p.directions[0].model.rotation_sine = f32::NAN, "a rotation"),
        (|p| p.directions[0].output = Some(1), "an output of the agent"),
        (|p| p.directions[1].parent = Some(2), "a neighbour's place"),
        (|p| p.directions[1].spare = Some(254), "a neighbour's place"),
        (|p| p.inverse[(1, 0)] = 0.125, "the inverse of the transform"),
        (|p| p.transform[(0, 0)] = f32::NAN, "the inverse of the transform"),
        (|p| p.inverse = SMatrix::zeros(), "the inverse of the transform"),
    ];
    for (change, expected) in refused {
        let mut params = params();
        change(&mut params);
        match params.validate(1, 2, 1e-3) {
            Err(ParameterError::OutOfRange { parameter: "field", expected: found, .. }) => {
                assert_eq!(found, expected);
            }
            other => panic!("{expected}: {other:?}"),
        }
    }
    // At a smaller step, larger gains are in range.
    let mut fast = params();
    fast.directions[0].root_gain = 2000.0;
    assert_eq!(fast.validate(1, 2, 1e-4), Ok(()));
}

#[test]
fn an_announcement_that_does_not_fit_is_refused() {
    let with = |count: usize, hold: HoldKind, is_half: bool, clip: f32| {
        let model = Model { clip, ..turning(0.01) };
        let mut directions = [Direction { model, ..Direction::NONE }; 6];
        directions.iter_mut().take(count).for_each(|direction| direction.is_announced = true);
        let params = FieldParams::<6> {
            options: Options { hold, is_half, ..params().options },
            transform: SMatrix::identity(),
            inverse: SMatrix::identity(),
            low: zeros(),
            high: zeros(),
            directions,
        };
        params.validate(1, 0, 1e-3).is_ok()
    };
    // 1 + 6 + 6 + 3 k words, and without rates 1 + 6 + 3 k.
    assert!(with(1, HoldKind::Rate, false, 1.0) && !with(2, HoldKind::Rate, false, 1.0));
    assert!(!with(2, HoldKind::Model, false, 1.0)); // it falls back to rates
    assert!(with(3, HoldKind::ZeroOrder, false, 1.0) && !with(4, HoldKind::ZeroOrder, false, 1.0));
    assert!(with(6, HoldKind::Rate, true, 1.0));
    // Directions without a model are not announced.
    assert!(with(6, HoldKind::Rate, false, 0.0));
}

#[test]
fn coordinates_and_shifts_belong_together() {
    let params = params();
    let mut state: StateVector<2> = [1.0, -2.0].into();
    assert_eq!([0, 1].map(|c| params.coordinate(c, &state)), [2.0, -7.0]);
    params.shift(&mut state, 1, 3.0);
    assert_eq!([0, 1].map(|c| params.coordinate(c, &state)), [2.0, -4.0]);
    params.shift(&mut state, 0, -3.0);
    assert_eq!([0, 1].map(|c| params.coordinate(c, &state)), [-1.0, -4.0]);
    let vector = StateVector::<2>::new;
    assert_eq!(params.limited(&vector(-9.0, 9.0)), vector(-3.0, 4.0));
    let infinite = vector(f32::INFINITY, f32::NEG_INFINITY);
    assert_eq!(params.limited(&infinite), vector(3.0, -4.0));
}

/// A root that measures `x`, with `dx/dt = d`, at a step of 1 ms.
fn observed(model: &Model, root_gain: f32, d: impl Fn(f64) -> f64) -> (f64, Disturbance) {
    let (mut x, mut estimate, mut disturbance) = (0.0_f64, 0.0_f32, Disturbance::NONE);
    for step in 0..10_000 {
        let nu = x as f32 - estimate;
        estimate += 1e-3 * (model.clipped(&disturbance) + root_gain * nu);
        disturbance = model.corrected(&disturbance, 1e-3 * nu);
        x += 1e-3 * d(f64::from(step) * 1e-3);
    }
    (x - f64::from(estimate), disturbance)
}

#[test]
fn a_bias_converges_to_a_constant_disturbance() {
    let model = Model { bias_gain: 6400.0, clip: 5.0, ..Model::NONE };
    let (error, disturbance) = observed(&model, 113.0, |_| 2.5);
    assert!(error.abs() < 1e-4 && (disturbance.bias - 2.5).abs() < 1e-2, "{disturbance:?}");
    assert_eq!((disturbance.cosine, disturbance.sine), (0.0, 0.0));
    // One that is beyond the clip leaves the root's own gain to make up for the rest.
    let (error, disturbance) = observed(&model, 113.0, |_| 8.0);
    assert_eq!(disturbance.bias, 5.0);
    assert!((error - 3.0 / 113.0).abs() < 1e-3, "{error}");
    // Without a model there is nothing.
    let (error, disturbance) = observed(&Model::NONE, 100.0, |_| 1.0);
    assert!((error - 0.01).abs() < 1e-4);
    assert_eq!(disturbance, Disturbance::NONE);
}

#[test]
fn an_oscillation_is_followed_by_its_model() {
    let model = Model { bias_gain: 393.0, cosine_gain: 280.0, sine_gain: 480.0, ..turning(3.8e-3) };
    let (error, disturbance) = observed(&model, 37.0, |t| 1.5 * libm::sin(3.8 * t));
    let amplitude = libm::hypot(f64::from(disturbance.cosine), f64::from(disturbance.sine));
    assert!(error.abs() < 1e-3 && (amplitude - 1.5).abs() < 0.05, "{error} {disturbance:?}");
    assert!(disturbance.bias.abs() < 0.05);
}

#[test]
fn a_rotation_keeps_its_amplitude_over_a_million_steps() {
    for angle in [3.8e-3, 0.1, 1.0, 3.0e-4] {
        let model = turning(angle);
        let start = Disturbance { bias: 0.5, cosine: 3.0, sine: -4.0 };
        let mut free = start;
        for _ in 0..1_000_000 {
            free = model.unmeasured(&free, 1.0);
        }
        let amplitude = libm::hypot(f64::from(free.cosine), f64::from(free.sine));
        assert!((amplitude / 5.0 - 1.0).abs() < 0.12, "{angle}: {amplitude}");
        assert_eq!(free.bias, 0.5);
    }
}

#[test]
fn a_bias_without_measurement_decays() {
    let model = turning(0.0);
    let mut disturbance = Disturbance { bias: 4.0, cosine: 1.0, sine: 0.0 };
    for _ in 0..1_000 {
        disturbance = model.unmeasured(&disturbance, 0.999);
    }
    assert!((disturbance.bias / 4.0 - 0.3677).abs() < 1e-3);
    assert_eq!(disturbance.cosine, 1.0);
}

/// A frame can carry any finite numbers; none of them may become infinite or not a number on the way.
#[test]
fn a_disturbance_beyond_all_measure_comes_back_within_the_clip() {
    for angle in [0.0, 1e-3, 0.3, 1.0, 2.0] {
        let model = turning(angle);
        for signs in 0..8 {
            let sign = |bit: u32| if signs >> bit & 1 == 1 { f32::MIN } else { f32::MAX };
            let mut disturbance = Disturbance { bias: sign(0), cosine: sign(1), sine: sign(2) };
            for _ in 0..2_000 {
                assert!(model.clipped(&disturbance).abs() <= 10.0);
                disturbance = model.unmeasured(&disturbance, 0.999);
                assert!(disturbance.is_finite(), "{angle} {signs}: {disturbance:?}");
            }
        }
    }
}
