use super::*;
use crate::wire::secret::Secret;
use proptest::prelude::*;

const KEY: NetworkKey = NetworkKey::new(3, Secret::new([7; 16]));
const OTHER: NetworkKey = NetworkKey::new(3, Secret::new([8; 16]));

fn frame<V>(payload: Payload<V>) -> AuthenticFrame<V> {
    AuthenticFrame { sender: 2, stamp: Stamp { epoch: 300, sequence: 5 }, tick: 70_000, payload }
}

fn opened(bytes: &[u8]) -> Result<AuthenticFrame<StateVector<2>>, FrameError> {
    AuthenticFrame::open(bytes, &[NetworkKey::new(1, Secret::new([1; 16])), KEY])
}

#[test]
fn the_wire_format_matches_the_table() {
    let bytes = frame(Payload::Estimate(&[1.0, -2.5][..])).seal(&KEY);
    let body = [2, 3, 2, 0xac, 0x02, 5, 0xf0, 0xa2, 0x04, 0, 2, 0, 0, 0x80, 0x3f, 0, 0, 0x20, 0xc0];
    assert_eq!(&bytes[..body.len()], body);
    assert_eq!(bytes.len(), body.len() + TAG_LENGTH);
    let hello = frame(Payload::<&[f32]>::Hello).seal(&KEY);
    assert_eq!(hello[9..hello.len() - TAG_LENGTH], [1]);
    let sync = frame(Payload::Sync { to: 4, epoch: 9, estimate: &[0.0][..] }).seal(&KEY);
    assert_eq!(sync[9..sync.len() - TAG_LENGTH], [2, 4, 9, 1, 0, 0, 0, 0]);
}

/// SipHash-2-4 of the bytes 0 to 14 with the key 0 to 15, from the algorithm's paper.
#[test]
fn the_hash_is_the_one_of_its_paper() {
    let key = Secret::new(core::array::from_fn(|i| i as u8));
    let bytes: [u8; 15] = core::array::from_fn(|i| i as u8);
    assert_eq!(key.hash(&bytes), 0xa129_ca61_49be_45e5);
}

#[test]
fn the_longest_frame_fits() {
    let longest = AuthenticFrame {
        sender: AgentId::MAX,
        stamp: Stamp { epoch: u32::MAX, sequence: u32::MAX },
        tick: Tick::MAX,
        payload: Payload::Sync {
            to: AgentId::MAX,
            epoch: u32::MAX,
            estimate: &[f32::MIN; INPUTS_MAX][..],
        },
    };
    let bytes = longest.seal(&KEY);
    // Two numbers of an agent, five bytes each where it has 32 bits.
    assert_eq!(bytes.len(), LENGTH_MAX - 2 * (5 - (AgentId::BITS as usize).div_ceil(7)));
    let opened = AuthenticFrame::<StateVector<INPUTS_MAX>>::open(&bytes, &[KEY]).unwrap();
    assert_eq!(opened.stamp, longest.stamp);
}

#[test]
fn every_changed_bit_and_every_other_length_is_refused() {
    let payload = Payload::Estimate(&[1.0, -2.5][..]);
    let bytes = frame(payload).seal(&KEY);
    assert_eq!(opened(&bytes), Ok(frame(Payload::Estimate([1.0, -2.5].into()))));
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
    let bytes = frame(Payload::Estimate(&[1.0, -2.5][..])).seal(&OTHER);
    assert_eq!(opened(&bytes), Err(FrameError::Tag { sender: 2 }));
    let renumbered = NetworkKey::new(4, Secret::new([7; 16]));
    let bytes = frame(Payload::Estimate(&[1.0, -2.5][..])).seal(&renumbered);
    assert_eq!(opened(&bytes), Err(FrameError::Tag { sender: 2 }));
    // The same bytes have another tag from each sender.
    assert_ne!(KEY.tag(1, b"bytes"), KEY.tag(2, b"bytes"));
}

#[test]
fn an_authentic_frame_of_another_dimension_or_not_finite_is_refused() {
    let bytes = frame(Payload::Estimate(&[1.0][..])).seal(&KEY);
    assert_eq!(opened(&bytes), Err(FrameError::Dimension { expected: 2, found: 1 }));
    for estimate in [[f32::NAN, 0.0], [0.0, f32::INFINITY]] {
        for payload in [
            Payload::Estimate(&estimate[..]),
            Payload::Sync { to: 1, epoch: 2, estimate: &estimate[..] },
        ] {
            let bytes = frame(payload).seal(&KEY);
            assert_eq!(opened(&bytes), Err(FrameError::NotFinite { sender: 2 }));
        }
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
        let stamp = Stamp { epoch, sequence };
        fn payload<V>(kind: i32, to: AgentId, epoch: u32, estimate: V) -> Payload<V> {
            match kind {
                0 => Payload::Estimate(estimate),
                1 => Payload::Hello,
                _ => Payload::Sync { to, epoch, estimate },
            }
        }
        let frame =
            AuthenticFrame { sender, stamp, tick, payload: payload(kind, to, of, &estimate[..]) };
        let expected =
            AuthenticFrame { sender, stamp, tick, payload: payload(kind, to, of, estimate.into()) };
        prop_assert_eq!(opened(&frame.seal(&KEY)), Ok(expected));
    }

    #[test]
    fn bytes_without_the_key_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..LENGTH_MAX + 2)) {
        prop_assert!(opened(&bytes).is_err());
    }
}
