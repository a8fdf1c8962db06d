//! The content of frames, for people and scripts.

use agent_core::wire::announced::{Announced, HoldKind};
use agent_core::wire::frame::{AnyFrame, Frame, FrameError, Payload};
use agent_core::{AgentId, Tick};
use serde::Serialize;

use crate::packages::with_dimension;

/// The content of a frame of version 1.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameContent {
    /// The agent that broadcasts.
    pub sender: AgentId,
    /// Number of earlier broadcasts by this agent.
    pub sequence: u32,
    /// Tick at which the sample was taken.
    pub tick: Tick,
    /// `estimate`, `field` from an agent with the field observer, or `farewell` from one that stalls.
    pub kind: &'static str,
    /// `x_hat_i(t_k)`, shape `[n]`; `None` for a field announcement of unknown dimension and a farewell.
    pub estimate: Option<Vec<f32>>,
    /// How the sample goes on, from an agent with the field observer.
    pub announced: Option<AnnouncedContent>,
}

/// How a sample goes on until the next one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AnnouncedContent {
    /// Digest of what the sender predicts with; 0 without a network.
    pub digest: u16,
    /// `zero-order`, `rate` or `model`.
    pub hold: &'static str,
    /// The rate of the sample, shape `[n]`; 0 unless the hold is a rate hold. \[state unit/s\]
    pub rate: Vec<f32>,
    /// The announced directions, from 0.
    pub directions: Vec<usize>,
    /// Bias, cosine and sine of the disturbance in each of them.
    pub disturbances: Vec<[f32; 3]>,
}

/// Decodes a frame of version 1. The words of a field announcement do not say how many components the
/// state has: `dimension` does.
///
/// # Errors
/// As for [`Frame::decode`].
pub fn decode(bytes: &[u8], dimension: Option<usize>) -> Result<FrameContent, FrameError> {
    let frame = AnyFrame::decode(bytes)?;
    let (kind, expected) = match frame.payload {
        Payload::Estimate => ("estimate", Some(dimension.unwrap_or(frame.words.len()))),
        Payload::Field => ("field", dimension),
        Payload::Farewell => ("farewell", None),
    };
    match expected {
        Some(n) => with_dimension!(n, content(bytes), else Err(FrameError::Malformed)),
        None => Ok(FrameContent {
            sender: frame.sender,
            sequence: frame.sequence,
            tick: frame.tick,
            kind,
            estimate: None,
            announced: None,
        }),
    }
}

fn content<const N: usize>(bytes: &[u8]) -> Result<FrameContent, FrameError> {
    let Frame { sender, sequence, tick, estimate, announced, .. } = Frame::<N>::decode(bytes)?;
    Ok(FrameContent {
        sender,
        sequence,
        tick,
        kind: if announced.is_some() { "field" } else { "estimate" },
        estimate: Some(estimate.as_slice().to_vec()),
        announced: announced.as_ref().map(announcement),
    })
}

fn announcement<const N: usize>(announced: &Announced<N>) -> AnnouncedContent {
    let directions: Vec<usize> = (0..N).filter(|&c| announced.announces(c)).collect();
    let disturbances = directions.iter().map(|&c| {
        let disturbance = announced.disturbances[c];
        [disturbance.bias, disturbance.cosine, disturbance.sine]
    });
    AnnouncedContent {
        digest: announced.digest,
        hold: match announced.hold {
            HoldKind::ZeroOrder => "zero-order",
            HoldKind::Rate => "rate",
            HoldKind::Model => "model",
        },
        rate: announced.rate.as_slice().to_vec(),
        disturbances: disturbances.collect(),
        directions,
    }
}

#[cfg(test)]
mod tests {
    use agent_core::StateVector;

    use super::*;

    #[test]
    fn frames_decode_with_and_without_a_dimension() {
        let bytes = Frame::new(2, 7, 300, StateVector::<2>::new(1.0, -0.5)).encode();
        let found = decode(&bytes, None).unwrap();
        assert_eq!((found.sender, found.sequence, found.tick, found.kind), (2, 7, 300, "estimate"));
        assert_eq!(found.estimate, Some(vec![1.0, -0.5]));
        assert_eq!(decode(&bytes, Some(2)), Ok(found));
        assert_eq!(decode(&bytes, Some(3)), Err(FrameError::Dimension { expected: 3, found: 2 }));
        assert_eq!(decode(&bytes[1..], None), Err(FrameError::Checksum));
    }

    #[test]
    fn a_farewell_has_no_estimate() {
        let bytes = Frame::<2>::farewell(2, 7, 300).encode();
        for dimension in [None, Some(2)] {
            let found = decode(&bytes, dimension).unwrap();
            assert_eq!((found.sequence, found.kind, found.estimate), (7, "farewell", None));
        }
    }

    #[test]
    fn field_announcements_need_the_dimension_for_their_content() {
        let announced = Announced::<2> { directions: 2, has_harmonics: true, ..Announced::NONE };
        let frame =
            Frame { announced: Some(announced), ..Frame::new(1, 0, 0, StateVector::zeros()) };
        let bytes = frame.encode();
        assert_eq!(decode(&bytes, None).unwrap().estimate, None);
        let found = decode(&bytes, Some(2)).unwrap();
        assert_eq!(found.announced.unwrap().directions, [1]);
    }
}
