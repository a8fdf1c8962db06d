use super::*;
use crate::StateVector;
use crate::wire::frame::{Frame, Words};
use crate::wire::secret::Secret;
use proptest::prelude::*;

const KEY: NetworkKey = NetworkKey::new(3, Secret::new([7; 16]));
const OTHER: NetworkKey = NetworkKey::new(3, Secret::new([8; 16]));

fn header(kind: Kind) -> Header {
    Header { sender: 2, stamp: Stamp { epoch: 300, sequence: 5 }, tick: 70_000, kind }
}

fn sealed(kind: Kind, estimate: &[f32], key: &NetworkKey) -> Bytes {
    seal(&header(kind), &words(estimate), key)
}

fn words(numbers: &[f32]) -> Words {
    numbers.iter().map(|number| number.to_le_bytes()).collect()
}

fn opened(bytes: &[u8]) -> Result<(Header, StateVector<2>), FrameError> {
    let (header, words) = open(bytes, &[NetworkKey::new(1, Secret::new([1; 16])), KEY])?;
    let estimate = match header.kind.payload() {
        None => StateVector::zeros(),
        Some(payload) => Frame::of_content((header.sender, 0, 0), payload, words)?.estimate,
    };
    Ok((header, estimate))
}

#[test]
fn the_wire_format_matches_the_table() {
    let bytes = sealed(Kind::Estimate, &[1.0, -2.5], &KEY);
    let body = [2, 3, 2, 0xac, 0x02, 5, 0xf0, 0xa2, 0x04, 0, 0, 0, 0x80, 0x3f, 0, 0, 0x20, 0xc0];
    assert_eq!(&bytes[..body.len()], body);
    assert_eq!(bytes.len(), body.len() + TAG_LENGTH);
    let hello = sealed(Kind::Hello, &[], &KEY);
    assert_eq!(hello[9..hello.len() - TAG_LENGTH], [1]);
    let sync = sealed(Kind::Sync { to: 4, epoch: 9 }, &[0.0], &KEY);
    assert_eq!(sync[9..sync.len() - TAG_LENGTH], [2, 4, 9, 0, 0, 0, 0]);
}

#[test]
fn the_longest_frame_fits() {
    let longest = Header {
        sender: AgentId::MAX,
        stamp: Stamp { epoch: u32::MAX, sequence: u32::MAX },
        tick: Tick::MAX,
        kind: Kind::Sync { to: AgentId::MAX, epoch: u32::MAX },
    };
    let most = [f32::MIN.to_le_bytes(); WORDS_MAX];
    let bytes = seal(&longest, &most, &KEY);
    assert_eq!(bytes.len(), LENGTH_MAX);
    assert_eq!(open(&bytes, &[KEY]), Ok((longest, &most[..])));
    assert!(seal(&longest, &[[0; 4]; WORDS_MAX + 1], &KEY).is_empty());
}

#[test]
fn every_changed_bit_and_every_other_length_is_refused() {
    let bytes = sealed(Kind::Estimate, &[1.0, -2.5], &KEY);
    assert_eq!(opened(&bytes), Ok((header(Kind::Estimate), [1.0, -2.5].into())));
    for bit in 0..8 * bytes.len() {
        let mut changed = bytes.clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert!(opened(&changed).is_err(), "bit {bit}");
    }
    for length in 0..bytes.len() {
        assert!(opened(&bytes[..length]).is_err(), "{length} bytes");
    }
    let mut longer = bytes.clone();
    longer.push(0).unwrap();
    assert!(opened(&longer).is_err());
    assert!(opened(&[2; LENGTH_MAX + 1]).is_err());
}

#[test]
fn another_key_and_another_sender_give_other_tags() {
    let bytes = sealed(Kind::Estimate, &[1.0, -2.5], &OTHER);
    assert_eq!(opened(&bytes), Err(FrameError::Tag { sender: 2 }));
    let renumbered = NetworkKey::new(4, Secret::new([7; 16]));
    let bytes = sealed(Kind::Estimate, &[1.0, -2.5], &renumbered);
    assert_eq!(opened(&bytes), Err(FrameError::Tag { sender: 2 }));
    // The same bytes have another tag from each sender.
    assert_ne!(KEY.tag(1, b"bytes"), KEY.tag(2, b"bytes"));
}

#[test]
fn an_estimate_of_another_dimension_or_not_finite_is_refused() {
    let bytes = sealed(Kind::Estimate, &[1.0], &KEY);
    assert_eq!(opened(&bytes), Err(FrameError::Dimension { expected: 2, found: 1 }));
    for estimate in [[f32::NAN, 0.0], [0.0, f32::INFINITY]] {
        for kind in [Kind::Estimate, Kind::Sync { to: 1, epoch: 2 }] {
            let bytes = sealed(kind, &estimate, &KEY);
            assert_eq!(opened(&bytes), Err(FrameError::NotFinite { sender: 2 }));
        }
    }
}

#[test]
fn only_a_hello_and_a_farewell_have_no_estimate() {
    assert_eq!(opened(&sealed(Kind::Hello, &[1.0, 2.0], &KEY)), Err(FrameError::Malformed));
    assert_eq!(opened(&sealed(Kind::Farewell, &[1.0, 2.0], &KEY)), Err(FrameError::Malformed));
    let farewell = sealed(Kind::Farewell, &[], &KEY);
    assert_eq!(farewell[9..farewell.len() - TAG_LENGTH], [5]);
    let expected = (header(Kind::Farewell), StateVector::zeros());
    #[cfg(feature = "exchange")]
    assert_eq!(opened(&farewell), Ok(expected));
    #[cfg(not(feature = "exchange"))]
    assert_ne!(opened(&farewell), Ok(expected));
    for kind in [Kind::Estimate, Kind::Sync { to: 1, epoch: 2 }] {
        assert_eq!(opened(&sealed(kind, &[], &KEY)), Err(FrameError::Malformed));
    }
}

#[test]
fn the_key_is_not_printed() {
    let mut text = heapless::String::<100>::new();
    core::fmt::write(&mut text, format_args!("{KEY:?}")).unwrap();
    assert_eq!(text, "NetworkKey { number: 3, secret: Secret(..) }");
}

proptest! {
    #[test]
    fn opening_undoes_sealing(
        sender: AgentId, epoch: u32, sequence: u32, tick: Tick, kind in 0..3, to: AgentId, of: u32,
        estimate in prop::array::uniform2(-1e30f32..1e30),
    ) {
        let (kind, components) = match kind {
            0 => (Kind::Estimate, &estimate[..]),
            1 => (Kind::Hello, &[][..]),
            _ => (Kind::Sync { to, epoch: of }, &estimate[..]),
        };
        let header = Header { sender, stamp: Stamp { epoch, sequence }, tick, kind };
        let expected = if kind == Kind::Hello { [0.0; 2] } else { estimate };
        prop_assert_eq!(opened(&seal(&header, &words(components), &KEY)), Ok((header, expected.into())));
    }

    #[test]
    fn bytes_without_the_key_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..LENGTH_MAX + 2)) {
        prop_assert!(opened(&bytes).is_err());
    }
}
