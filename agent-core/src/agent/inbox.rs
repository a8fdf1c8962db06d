//! Holds received frames, already checked, until the next step.
//!
//! A link can deliver at any time; the observer processes frames at its next step. An inbox has one
//! slot per neighbour, so it can be filled from a receive routine and needs no queue.
//!
//! Memory: that of a [`Hold`] and 8 bytes per neighbour. Cost: linear in the length of the frame, plus a search
//! among the neighbours.
//!
//! A frame can carry any finite number. [`Inbox::accept_within`] also refuses implausible
//! estimates; without that check a single frame can make the receiver's step diverge.
//!
//! Whether a frame is newer than the held sample is decided when the step takes it over, because
//! only then is the receiver's time known: see [`crate::agent::hold`].
//!
//! Invariant: whatever arrives, an inbox holds at most one valid frame per neighbour, and a refused
//! frame changes nothing.

use crate::Tick;
use crate::agent::hold::{Hold, HoldSlots};
use crate::agent::region::Region;
use crate::observer::feedback::Neighbour;
use crate::wire::frame::{Frame, FrameError};

/// Slots for the next frame of each neighbour, in `S`: an array on the node, a vector on the host,
/// one entry per neighbour in the order of the agent's parameters.
///
/// ```
/// use agent_core::wire::frame::FrameError;
/// use agent_core::{Frame, Inbox, Neighbour, StateVector};
///
/// let neighbours = [Neighbour { id: 2, weight: 1.0 }];
/// let mut inbox = Inbox::<2, _>::new([None]);
/// let frame = Frame::new(2, 0, 0, StateVector::<2>::zeros());
/// assert_eq!(inbox.accept(&neighbours, &frame.encode()), Ok(()));
/// assert_eq!(inbox.len(), 1);
///
/// let stranger = Frame { sender: 9, ..frame };
/// let refusal = inbox.accept(&neighbours, &stranger.encode());
/// assert_eq!(refusal, Err(FrameError::UnknownSender { sender: 9 }));
/// ```
#[derive(Clone, Debug)]
pub struct Inbox<const N: usize, S> {
    pending: S,
    count: usize,
    /// Whether frames come from [`crate::agent::trust`], each newer than the previous ones.
    #[cfg(feature = "authentic-frames")]
    is_trusted: bool,
}

/// What became of pending frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Drained {
    /// How many were dropped as stale.
    pub(crate) stale: u32,
    /// Whether a neighbour is heard again that had said farewell.
    pub(crate) has_returned: bool,
}

impl<const N: usize, S> Inbox<N, S> {
    /// Creates an inbox with the given slots, which must all be empty, for a `static`.
    pub const fn blank(places: S) -> Self {
        Self {
            pending: places,
            count: 0,
            #[cfg(feature = "authentic-frames")]
            is_trusted: false,
        }
    }
}

impl<const N: usize, S: HoldSlots<N>> Inbox<N, S> {
    /// Creates an empty inbox; any contents of `places` are discarded.
    pub fn new(mut places: S) -> Self {
        places.as_mut().fill(None);
        Self::blank(places)
    }

    /// Decodes `bytes`, checks the frame against `neighbours`, and keeps it for the next step. It
    /// replaces an older pending frame of the same sender.
    ///
    /// # Errors
    /// Any error of [`Frame::decode`], an unknown sender, or a sender of which this frame or a
    /// newer one is already pending.
    pub fn accept(&mut self, neighbours: &[Neighbour], bytes: &[u8]) -> Result<(), FrameError> {
        self.keep(neighbours, &Frame::decode(bytes)?)
    }

    /// Like [`Self::accept`], but also refuses frames whose estimate is outside `region`, such as
    /// those of a neighbour that has diverged or observes another plant.
    ///
    /// # Errors
    /// Same as for [`Self::accept`], and [`FrameError::Implausible`].
    pub fn accept_within(
        &mut self,
        neighbours: &[Neighbour],
        region: &Region<N>,
        bytes: &[u8],
    ) -> Result<(), FrameError> {
        self.accept_decoded_within(neighbours, region, &Frame::decode(bytes)?)
    }

    /// Like [`Self::accept`], with a frame that has been decoded before, for another receiver.
    ///
    /// # Errors
    /// Same as for [`Self::accept`], except those of [`Frame::decode`].
    pub fn accept_decoded(
        &mut self,
        neighbours: &[Neighbour],
        frame: &Frame<N>,
    ) -> Result<(), FrameError> {
        self.keep(neighbours, frame)
    }

    /// Like [`Self::accept_within`], with a frame that has been decoded before, for another receiver.
    ///
    /// # Errors
    /// Same as for [`Self::accept_within`], except those of [`Frame::decode`].
    pub fn accept_decoded_within(
        &mut self,
        neighbours: &[Neighbour],
        region: &Region<N>,
        frame: &Frame<N>,
    ) -> Result<(), FrameError> {
        self.check_region(region, frame)?;
        self.keep(neighbours, frame)
    }

    /// Refuses an estimate outside `region`; a farewell has none.
    #[inline]
    fn check_region(&self, region: &Region<N>, frame: &Frame<N>) -> Result<(), FrameError> {
        if frame.is_farewell() || region.contains(&frame.estimate) {
            return Ok(());
        }
        Err(FrameError::Implausible { sender: frame.sender })
    }

    /// Keeps a frame that [`Trust`](crate::agent::trust::Trust) believes, if its estimate is in
    /// `region`. From now on every frame replaces the previous one from the same sender: the stamps
    /// have decided which is newer, so sequence, tick and silence no longer matter.
    ///
    /// # Errors
    /// [`FrameError::UnknownSender`] or [`FrameError::Implausible`].
    #[cfg(feature = "authentic-frames")]
    pub fn accept_believed(
        &mut self,
        neighbours: &[Neighbour],
        region: &Region<N>,
        frame: &Frame<N>,
    ) -> Result<(), FrameError> {
        self.check_region(region, frame)?;
        self.is_trusted = true;
        self.keep(neighbours, frame)
    }

    /// Whether the stamps have decided which frame is newer.
    #[inline]
    pub(crate) fn is_trusted(&self) -> bool {
        #[cfg(feature = "authentic-frames")]
        {
            self.is_trusted
        }
        #[cfg(not(feature = "authentic-frames"))]
        {
            false
        }
    }

    // Not inlined: its references are known not to overlap.
    #[inline(never)]
    fn keep(&mut self, neighbours: &[Neighbour], frame: &Frame<N>) -> Result<(), FrameError> {
        let sender = frame.sender;
        let unknown = FrameError::UnknownSender { sender };
        let place = neighbours.iter().position(|n| n.id == sender).ok_or(unknown)?;
        let is_trusted = self.is_trusted();
        let pending = self.pending.as_mut().get_mut(place).ok_or(unknown)?;
        let sample = Hold::of_frame(frame);
        match pending {
            // After a refused step, a frame can still be pending when the next one arrives.
            Some(waiting) if !is_trusted && !sample.is_newer_than(waiting) => {
                return Err(FrameError::DuplicateSender { sender });
            }
            Some(_) => {}
            None => self.count += 1,
        }
        *pending = Some(sample);
        Ok(())
    }

    /// Discards pending frames and returns the slots, to be resized to the number of neighbours.
    pub fn places(&mut self) -> &mut S {
        self.clear();
        &mut self.pending
    }

    /// Returns the number of pending frames.
    #[must_use]
    pub fn len(&self) -> usize {
        self.count
    }

    /// Returns whether no frame is pending.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Discards all pending frames.
    pub fn clear(&mut self) {
        self.pending.as_mut().fill(None);
        self.count = 0;
    }

    /// Discards pending frames whose estimate is outside `region`.
    pub fn discard_outside(&mut self, region: &Region<N>) {
        self.count -= region.discard_outside(self.pending.as_mut());
    }

    /// Discards pending frames in slots for which `keep` returns false.
    pub(crate) fn keep_places(&mut self, keep: impl Fn(usize) -> bool) {
        for (place, waiting) in self.pending.as_mut().iter_mut().enumerate() {
            if !keep(place) && waiting.take().is_some() {
                self.count -= 1;
            }
        }
    }

    /// Returns the pending frames, one slot per neighbour.
    pub(crate) fn pending(&self) -> &[Option<Hold<N>>] {
        self.pending.as_ref()
    }

    /// Moves every pending frame into its sender's slot in `holds` at step `now`, as what `arrived`
    /// makes of it and of the held one, unless that is newer.
    #[inline]
    pub(crate) fn drain_into(
        &mut self,
        holds: &mut [Option<Hold<N>>],
        now: Tick,
        silence: Tick,
        arrived: impl Fn(&Hold<N>, Option<&Hold<N>>) -> Hold<N>,
    ) -> Drained {
        let mut drained = Drained::default();
        if self.is_empty() {
            return drained;
        }
        let is_trusted = self.is_trusted();
        for (hold, pending) in holds.iter_mut().zip(self.pending.as_mut()) {
            let Some(sample) = pending else { continue };
            let held = hold.as_ref();
            if held.is_some_and(|held| !is_trusted && !sample.replaces(held, now, silence)) {
                drained.stale += 1;
            } else {
                let was_absent = held.is_some_and(Hold::is_absent);
                drained.has_returned |= was_absent && !sample.is_absent();
                *hold = Some(arrived(sample, held));
            }
            *pending = None;
        }
        self.count = 0;
        drained
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newer_frame_replaces_a_pending_one() {
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

    #[cfg(feature = "authentic-frames")]
    #[test]
    fn a_believed_frame_replaces_every_other() {
        let mut inbox = Inbox::<2, _>::new([None; 2]);
        let region = Region::unlimited();
        let mut holds = [None, Some(Hold::new([0.0; 2].into(), 1_000, 1_000).taken_over(50))];
        let restarted = Frame { sequence: 0, tick: 0, ..frame(9) };
        assert_eq!(inbox.accept_believed(&NEIGHBOURS, &region, &frame(9)), Ok(()));
        assert_eq!(inbox.accept_believed(&NEIGHBOURS, &region, &restarted), Ok(()));
        assert_eq!(drain(&mut inbox, &mut holds, 51, 1_000), 0);
        assert_eq!(holds[1].map(|hold| hold.sequence()), Some(0));
    }

    /// The consensus term and the held sample of a step agree, also on a sample that only its stamp
    /// makes newer.
    #[cfg(feature = "authentic-frames")]
    #[test]
    fn a_believed_frame_of_a_restarted_neighbour_reaches_the_consensus_term() {
        use crate::StateVector;
        use crate::agent::{AgentParams, AgentState};
        use crate::math::symmetric::SymmetricMatrix;
        use crate::observer::feedback::{ObserverParams, OutputMatrix};
        use crate::observer::network::InnerNetwork;
        use crate::observer::outer_law::OuterLawParams;
        use crate::observer::projection::ProjectionParams;
        use crate::observer::trigger::TriggerParams;

        let neighbours = [Neighbour { id: 9, weight: 1.0 }];
        let observer = ObserverParams {
            output_matrix: OutputMatrix::new(&[StateVector::<2>::new(1.0, 0.0)]).unwrap(),
            gain: nalgebra::SMatrix::identity(),
            neighbours: &neighbours,
        };
        let projection =
            ProjectionParams { radius: 9.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
        let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection };
        let trigger =
            TriggerParams { hold_error_weight: 1.0, consensus_weight: 0.1, threshold: 1e9 };
        let params = AgentParams::new(1, 1e-3, observer, outer_law, trigger).unwrap();
        let mut state =
            AgentState::<2, 1, _>::new(&params, StateVector::zeros(), &[0.0; 2], [None]).unwrap();
        let mut inbox = Inbox::<2, _>::new([None]);
        let region = Region::unlimited();
        let old = Frame { sequence: 1_000, tick: 50_000, estimate: [4.0, 0.0].into(), ..frame(9) };
        let restarted = Frame { sequence: 0, tick: 0, estimate: [-7.0, 3.0].into(), ..frame(9) };
        for (tick, sent) in [(0, old), (1, restarted)] {
            inbox.accept_believed(&neighbours, &region, &sent).unwrap();
            let network = None::<&InnerNetwork<&[f32]>>;
            state.step(&params, network, tick, &[0.0], &mut inbox).unwrap();
            // The agent's own sample is still zero.
            assert_eq!(state.consensus_term(), &sent.estimate);
            let held = state.neighbour_holds()[0].unwrap();
            assert_eq!(held.estimate(), &sent.estimate);
        }
    }

    /// Drains as the paper's exchange does.
    fn drain(
        inbox: &mut Inbox<2, [Option<Hold<2>>; 2]>,
        holds: &mut [Option<Hold<2>>],
        now: Tick,
        silence: Tick,
    ) -> u32 {
        inbox.drain_into(holds, now, silence, |sample, _| sample.taken_over(now)).stale
    }

    const NEIGHBOURS: [Neighbour; 2] =
        [Neighbour { id: 4, weight: 1.0 }, Neighbour { id: 9, weight: 1.0 }];

    fn frame(sender: crate::AgentId) -> Frame<2> {
        Frame::new(sender, 5, 11, [1.0, 2.0].into())
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
        assert_eq!(drain(&mut inbox, &mut holds, 12, 10), 0);
        let new = Hold::new([1.0, 2.0].into(), 11, 5).taken_over(12);
        assert_eq!(holds, [Some(old), Some(new)]);
        assert!(inbox.is_empty());
    }

    #[test]
    fn draining_drops_what_is_not_newer_than_what_is_held() {
        let held = Hold::new([7.0, 7.0].into(), 11, 5).taken_over(12);
        let mut holds = [None, Some(held)];
        for (now, dropped) in [(13, 1), (22, 1), (23, 0)] {
            let mut inbox = Inbox::<2, _>::new([None; 2]);
            inbox.accept(&NEIGHBOURS, &frame(9).encode()).unwrap();
            assert_eq!(drain(&mut inbox, &mut holds, now, 10), dropped, "{now}");
            assert!(inbox.is_empty());
            assert_eq!(holds[1] == Some(held), dropped == 1);
        }
    }

    #[test]
    fn an_implausible_estimate_is_refused_or_discarded() {
        let region = Region::new([-5.0, -5.0].into(), [5.0, 5.0].into()).unwrap();
        let mut inbox = Inbox::<2, _>::new([None; 2]);
        let huge = Frame::<2> { estimate: [1.0, 1e30].into(), ..frame(9) }.encode();
        let implausible = Err(FrameError::Implausible { sender: 9 });
        assert_eq!(inbox.accept_within(&NEIGHBOURS, &region, &huge), implausible);
        assert!(inbox.is_empty());
        assert_eq!(inbox.accept_within(&NEIGHBOURS, &region, &frame(4).encode()), Ok(()));
        assert_eq!(inbox.accept(&NEIGHBOURS, &huge), Ok(()));
        inbox.discard_outside(&region);
        assert_eq!(inbox.len(), 1);
        assert!(inbox.pending()[0].is_some() && inbox.pending()[1].is_none());
    }

    #[test]
    fn a_decoded_frame_is_kept_as_its_bytes_are() {
        let region = Region::new([-5.0, -5.0].into(), [5.0, 5.0].into()).unwrap();
        let huge = Frame::<2> { estimate: [1.0, 1e30].into(), ..frame(4) };
        for frame in [frame(4), frame(9), frame(9), frame(5), huge] {
            let mut inboxes = [(); 4].map(|()| Inbox::<2, _>::new([None; 2]));
            let [bytes, decoded, bytes_within, decoded_within] = &mut inboxes;
            assert_eq!(
                bytes.accept(&NEIGHBOURS, &frame.encode()),
                decoded.accept_decoded(&NEIGHBOURS, &frame)
            );
            assert_eq!(bytes.pending(), decoded.pending());
            assert_eq!(
                bytes_within.accept_within(&NEIGHBOURS, &region, &frame.encode()),
                decoded_within.accept_decoded_within(&NEIGHBOURS, &region, &frame)
            );
            assert_eq!(bytes_within.pending(), decoded_within.pending());
        }
    }
}
