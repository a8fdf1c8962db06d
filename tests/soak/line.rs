//! The line to a node: disturbs the messages on it, and determines which of them a receiver can
//! decode.
//!
//! [`heard`] decodes the stream with a second, bitwise implementation of the framing, which shares
//! no code with the one on the node.

use agent_core::service::{REQUEST_LENGTH_MAX, Request, send};
use rand::{Rng, RngExt};

use super::rates::Message;
use super::report::Tally;

/// Longest message, including its checksum, that a node can hold.
const ROOM: usize = REQUEST_LENGTH_MAX + 4;

/// Encodes and frames a request.
pub(super) fn encoded(request: &Request<'_>) -> Vec<u8> {
    let mut bytes = Vec::new();
    send(request, |block| bytes.extend_from_slice(block));
    bytes
}

/// Returns the stream for `messages` after random faults.
pub(super) fn disturbed(
    mut messages: Vec<Vec<u8>>,
    rates: &Message,
    rng: &mut impl Rng,
    tally: &mut Tally,
) -> Vec<u8> {
    for place in 1..messages.len() {
        if rng.random_bool(rates.overtaken) {
            tally.fault("message overtaken");
            messages.swap(place - 1, place);
        }
    }
    let mut stream = Vec::new();
    for mut message in messages {
        if rng.random_bool(rates.noise) {
            tally.fault("noise between messages");
            let length = rng.random_range(1..=300);
            stream.extend((0..length).map(|_| rng.random::<u8>()));
            // As sent by a sender that restarts.
            stream.push(0);
        }
        if rng.random_bool(rates.lost) {
            tally.fault("message lost");
            continue;
        }
        if rng.random_bool(rates.repeated) {
            tally.fault("message repeated");
            stream.extend_from_slice(&message);
        }
        if rng.random_bool(rates.flipped) {
            tally.fault("message with flipped bytes");
            for _ in 0..rng.random_range(1..=3) {
                let place = rng.random_range(0..message.len());
                message[place] ^= rng.random_range(1..=255u8);
            }
        }
        if rng.random_bool(rates.cut) {
            tally.fault("message cut");
            message.truncate(rng.random_range(0..message.len()));
        }
        stream.extend_from_slice(&message);
    }
    stream
}

/// Returns the messages in `stream`; `None` for a damaged one.
pub(super) fn heard(stream: &[u8]) -> Vec<Option<Vec<u8>>> {
    let segments = stream.split(|&byte| byte == 0);
    segments.filter(|segment| !segment.is_empty()).map(message).collect()
}

fn message(segment: &[u8]) -> Option<Vec<u8>> {
    let (mut message, mut rest) = (Vec::new(), segment);
    while let Some((&code, tail)) = rest.split_first() {
        let (data, next) = tail.split_at_checked(usize::from(code) - 1)?;
        message.extend_from_slice(data);
        if code < 255 && !next.is_empty() {
            message.push(0);
        }
        rest = next;
    }
    let body = message.len().checked_sub(4).filter(|_| message.len() <= ROOM)?;
    let checksum = message.split_off(body);
    (checksum == crc32(&message).to_le_bytes()).then_some(message)
}

/// CRC-32 by its definition: polynomial division over the field with two elements.
fn crc32(bytes: &[u8]) -> u32 {
    let divided = bytes.iter().fold(u32::MAX, |rest, &byte| {
        (0..8).fold(rest ^ u32::from(byte), |rest, _| {
            if rest & 1 == 1 { rest >> 1 ^ 0xedb8_8320 } else { rest >> 1 }
        })
    });
    !divided
}

#[test]
fn the_second_decoder_finds_exactly_the_sent_messages() {
    let long = [&[0, 7][..], &[0xa5; 126]].concat();
    let requests = [
        Request::Query,
        Request::Chunk { offset: 0, bytes: &long },
        Request::Begin { length: 256 },
    ];
    let mut stream: Vec<u8> = requests.iter().flat_map(encoded).collect();
    let whole = heard(&stream);
    assert!(whole.iter().zip(&requests).all(|(message, request)| {
        message.as_deref().and_then(agent_core::service::receive) == Some(request.clone())
    }));
    assert_eq!(whole.len(), 3);
    stream[20] ^= 8;
    assert_eq!(heard(&stream).iter().map(Option::is_some).collect::<Vec<_>>(), [true, false, true]);
}
