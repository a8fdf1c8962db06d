//! Received frames, checked, waiting for the next step.
//!
//! A link can deliver at any time; the observer takes notice at its next step. An inbox has
//! one place for each neighbour, so it can be filled from a receive routine and needs no
//! queue.
//!
//! Memory: `4 N + 24` bytes a neighbour. Cost: the frame's length, and a search among the
//! neighbours.
//!
//! Invariant: whatever arrives, an inbox holds at most one valid frame of each neighbour, and
//! a refused one changes nothing.

use crate::frame::{Frame, FrameError};
use crate::hold::Hold;
use crate::observer::Neighbour;
use crate::sequence::is_newer;

/// Places for the next frame of each neighbour, in `S`: an array on the node, a vector on
/// the host, one entry for each neighbour in the order of the agent's parameters.
#[derive(Clone, Debug)]
pub struct Inbox<const N: usize, S> {
    pending: S,
    count: usize,
}

impl<const N: usize, S: AsRef<[Option<Hold<N>>]> + AsMut<[Option<Hold<N>>]>> Inbox<N, S> {
    /// An empty inbox; what `places` hold is discarded.
    pub fn new(mut places: S) -> Self {
        places.as_mut().fill(None);
        Self { pending: places, count: 0 }
    }

    /// Decodes `bytes`, checks the frame against `neighbours`, and keeps it for the next step, in
    /// place of an older one of the same sender that still waits.
    ///
    /// # Errors
    /// What [`Frame::decode`] refuses, and a sender that is unknown or already has this frame
    /// or a newer one waiting.
    pub fn accept(&mut self, neighbours: &[Neighbour], bytes: &[u8]) -> Result<(), FrameError> {
        let frame = Frame::<N>::decode(bytes)?;
        let sender = frame.sender;
        let unknown = FrameError::UnknownSender { sender };
        let place = neighbours.iter().position(|n| n.id == sender).ok_or(unknown)?;
        let pending = self.pending.as_mut().get_mut(place).ok_or(unknown)?;
        match pending {
            // After a step that was refused, a frame can still wait when the next one comes.
            Some(waiting) if !is_newer(frame.sequence, waiting.sequence()) => {
                return Err(FrameError::DuplicateSender { sender });
            }
            Some(_) => {}
            None => self.count += 1,
        }
        *pending = Some(Hold::new(frame.estimate, frame.tick, frame.sequence));
        Ok(())
    }

    /// How many frames wait.
    #[must_use]
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether no frame waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Discards what waits.
    pub fn clear(&mut self) {
        self.pending.as_mut().fill(None);
        self.count = 0;
    }

    /// The waiting frames, one place for each neighbour.
    pub(crate) fn pending(&self) -> &[Option<Hold<N>>] {
        self.pending.as_ref()
    }

    /// Moves every waiting frame into the place of its sender among `holds`.
    pub(crate) fn drain_into(&mut self, holds: &mut [Option<Hold<N>>]) {
        for (hold, pending) in holds.iter_mut().zip(self.pending.as_mut()) {
            if let Some(sample) = pending.take() {
                *hold = Some(sample);
            }
        }
        self.count = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newer_frame_takes_the_place_of_one_that_waits() {
        let mut inbox = Inbox::<2, _>::new([None; 2]);
        let with = |sequence| Frame { sequence, ..frame(9) }.encode();
        assert_eq!(inbox.accept(&NEIGHBOURS, &with(u32::MAX)), Ok(()));
        assert_eq!(inbox.accept(&NEIGHBOURS, &with(0)), Ok(()));
        for old in [0, u32::MAX] {
            let duplicate = Err(FrameError::DuplicateSender { sender: 9 });
            assert_eq!(inbox.accept(&NEIGHBOURS, &with(old)), duplicate);
        }
        assert_eq!(inbox.len(), 1);
        assert_eq!(inbox.pending()[1].unwrap().sequence(), 0);
    }

    const NEIGHBOURS: [Neighbour; 2] =
        [Neighbour { id: 4, weight: 1.0 }, Neighbour { id: 9, weight: 1.0 }];

    fn frame(sender: u16) -> Frame<2> {
        Frame { sender, sequence: 5, tick: 11, estimate: [1.0, 2.0].into() }
    }

    #[test]
    fn a_refused_frame_changes_nothing() {
        let mut inbox = Inbox::<2, _>::new([None; 2]);
        assert_eq!(inbox.accept(&NEIGHBOURS, &frame(9).encode()), Ok(()));
        let before = inbox.clone();
        let mut corrupt = frame(4).encode();
        corrupt[6] ^= 1;
        for (bytes, error) in [
            (frame(5).encode(), FrameError::UnknownSender { sender: 5 }),
            (frame(9).encode(), FrameError::DuplicateSender { sender: 9 }),
            (corrupt, FrameError::Checksum),
        ] {
            assert_eq!(inbox.accept(&NEIGHBOURS, &bytes), Err(error));
            assert_eq!(inbox.pending(), before.pending());
            assert_eq!(inbox.len(), 1);
        }
    }

    #[test]
    fn draining_replaces_only_what_arrived() {
        let mut inbox = Inbox::<2, _>::new([None; 2]);
        inbox.accept(&NEIGHBOURS, &frame(9).encode()).unwrap();
        let old = Hold::new([7.0, 7.0].into(), 1, 0);
        let mut holds = [Some(old), Some(old)];
        inbox.drain_into(&mut holds);
        assert_eq!(holds, [Some(old), Some(Hold::new([1.0, 2.0].into(), 11, 5))]);
        assert!(inbox.is_empty());
    }
}
