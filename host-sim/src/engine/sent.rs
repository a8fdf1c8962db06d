//! The last broadcast of every agent, decoded at most once for all that receive it.
//!
//! A receiver looks a frame up by the sender that its bytes name and accepts what is known of it only if all
//! bytes are those that were sent. Frames that a link has changed or delayed past the next broadcast are
//! decoded by their receivers, so what an agent receives does not depend on this.
//!
//! Cost: for each copy a comparison of its bytes in place of a checksum and a decoding.

use agent_core::agent::hold::HoldSlots;
use agent_core::agent::inbox::Inbox;
use agent_core::health::WatchedAgent;
use agent_core::observer::feedback::Neighbour;
use agent_core::wire::frame::{Frame, FrameBytes, FrameError, named_sender};

/// See the module documentation.
#[derive(Debug)]
pub(super) struct Sent<const N: usize> {
    /// For the agents in order, whose identifiers count from 1.
    last: Vec<(FrameBytes, Option<Frame<N>>)>,
}

impl<const N: usize> Sent<N> {
    pub(super) fn new(agents: usize) -> Self {
        Self { last: vec![(FrameBytes::new(), None); agents] }
    }

    /// Keeps what `sender`, from 0, broadcasts, with its bytes.
    #[inline]
    pub(super) fn note(&mut self, sender: usize, frame: &Frame<N>, bytes: &FrameBytes) {
        let (sent, kept) = &mut self.last[sender];
        // In place: there is room for far longer frames, which need not be copied.
        sent.clear();
        let _ = sent.extend_from_slice(bytes);
        // The numbers of a field announcement may be rounded in its bytes.
        *kept = match frame.announced {
            None => Some(*frame),
            Some(_) => Frame::decode(bytes).ok(),
        };
        debug_assert_eq!(*kept, Frame::decode(bytes).ok());
    }

    /// Keeps a frame for the next step of an agent that is not monitored: [`Inbox::accept`].
    #[inline]
    pub(super) fn accept<I: HoldSlots<N>>(
        &self,
        inbox: &mut Inbox<N, I>,
        neighbours: &[Neighbour],
        bytes: &[u8],
    ) -> Result<(), FrameError> {
        match self.frame(bytes) {
            Some(frame) => inbox.accept_decoded(neighbours, frame),
            None => inbox.accept(neighbours, bytes),
        }
    }

    /// Keeps a frame for the next step of an agent that is monitored: [`WatchedAgent::receive`].
    #[inline]
    pub(super) fn receive<const FEATURES: usize, S: HoldSlots<N>, I: HoldSlots<N>>(
        &self,
        agent: &mut WatchedAgent<'_, N, FEATURES, S, I>,
        bytes: &[u8],
    ) -> Result<(), FrameError> {
        match self.frame(bytes) {
            Some(frame) => agent.receive_decoded(frame),
            None => agent.receive(bytes),
        }
    }

    /// Returns the frame that these bytes are, if it is the last one of its sender.
    #[inline]
    fn frame(&self, bytes: &[u8]) -> Option<&Frame<N>> {
        let sender = usize::try_from(named_sender(bytes)?).ok()?.checked_sub(1)?;
        let (sent, frame) = self.last.get(sender)?;
        frame.as_ref().filter(|_| sent[..] == *bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_bytes_that_were_sent_are_found() {
        let mut sent = Sent::<2>::new(300);
        for sender in [1, 200, 300] {
            let frame = Frame::new(sender, 7, 40, [0.1, -2.0].into());
            let bytes = frame.encode();
            assert_eq!(sent.frame(&bytes), None);
            sent.note(sender as usize - 1, &frame, &bytes);
            assert_eq!(sent.frame(&bytes), Some(&frame));
            for bit in 0..8 * bytes.len() {
                let mut changed = bytes.clone();
                changed[bit / 8] ^= 1 << (bit % 8);
                assert_eq!(sent.frame(&changed), None);
            }
            assert_eq!(sent.frame(&bytes[..bytes.len() - 1]), None);
            // The next broadcast replaces it.
            let next = Frame::<2> { sequence: 8, ..frame };
            sent.note(sender as usize - 1, &next, &next.encode());
            assert_eq!(sent.frame(&bytes), None);
        }
        for stranger in [0, 301, u32::MAX] {
            assert_eq!(
                sent.frame(&Frame::<2>::new(stranger, 0, 0, [0.0; 2].into()).encode()),
                None
            );
        }
    }
}
