//! Tests of a client against peers on a socket.

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;

use agent_core::wire::cobs::Encoder;

use super::*;
use crate::service::push::status;

const RETRY_POLICY: RetryPolicy = RetryPolicy { timeout: Duration::from_millis(100), tries: 2 };

fn framed(message: &[u8]) -> Vec<u8> {
    let mut framed = Vec::new();
    let mut encoder = Encoder::new(|bytes: &[u8]| framed.extend_from_slice(bytes));
    encoder.extend(message);
    encoder.finish();
    framed
}

/// Returns the error of a status request to a peer that keeps sending `bytes`.
fn status_of(bytes: Vec<u8>) -> ServiceError {
    let (here, mut there) = UnixStream::pair().unwrap();
    there.set_nonblocking(true).unwrap();
    let peer = std::thread::spawn(move || {
        let mut requests = [0; 1024];
        loop {
            if matches!(there.read(&mut requests), Ok(0)) {
                return;
            }
            if there.write(&bytes).is_err_and(|e| e.kind() != std::io::ErrorKind::WouldBlock) {
                return;
            }
        }
    });
    let mut client = Client::new(Line::over_socket(here, &std::sync::Arc::default()).unwrap());
    let error = status(&mut client, RETRY_POLICY).unwrap_err();
    drop(client);
    peer.join().unwrap();
    error
}

#[test]
fn another_protocol_version_is_reported() {
    // A status with unknown fields, and one that happens to fit.
    for message in [&[0, 2][..], &[0, 2, 1, 2, 3, 4, 5, 6, 7], &[1, 9]] {
        let error = status_of(framed(message));
        let found = message[1];
        assert!(matches!(error, ServiceError::Protocol { found: f } if f == found), "{error}");
        assert!(error.to_string().contains("build both from the same source"), "{error}");
    }
}

#[test]
fn endless_garbage_is_reported_after_the_timeout() {
    let mut seed = 1u32;
    let garbage = (0..4000).map(|_| {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 24) as u8
    });
    let error = status_of(garbage.collect());
    let ServiceError::Garbage { bytes, damaged, intact, .. } = error else { panic!("{error}") };
    assert!(bytes > 4000 && damaged > 0 && intact == 0, "{error}");
    assert!(error.to_string().contains("baud rate"), "{error}");
    // Without a delimiter, not even a damaged message is received.
    let error = status_of(vec![0x55; 4000]);
    assert!(matches!(error, ServiceError::Garbage { damaged: 0, .. }), "{error}");
}

#[test]
fn unknown_unsolicited_messages_are_skipped() {
    // An unknown kind of message and an unknown event.
    for message in [&[100, 1, 2][..], &[11, 100, 1]] {
        assert!(matches!(decode(message), Err(ServiceError::Unrecognised(_))));
        let error = status_of(framed(message));
        assert!(matches!(error, ServiceError::Line(LineError::Silent)), "{error}");
    }
    // An invalid message of an answer's kind is not skipped: an upload without its length.
    let error = status_of(framed(&[2]));
    assert!(matches!(error, ServiceError::Unrecognised(_)), "{error}");
    // The kinds agree with `is_answer` for every known message.
    for (message, is_answer) in [(&[5][..], true), (&[8, 0], true), (&[11, 1, 0], false)] {
        assert!(decode(message).is_ok_and(|known| known.is_answer() == is_answer));
        assert_eq!(may_be_answer(message), is_answer);
    }
}

#[test]
fn whole_messages_without_end_do_not_hold_up_a_request() {
    // Unsolicited: postcard's `Health` with 15 counters.
    let mut health = vec![10, 0];
    health.extend([0; 15]);
    assert!(decode(&health).is_ok_and(|message| !message.is_answer()));
    let error = status_of(framed(&health));
    assert!(matches!(error, ServiceError::Line(LineError::Silent)), "{error}");
}
