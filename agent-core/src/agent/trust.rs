//! Decides which authentic frames to believe, and in what order a node speaks.
//!
//! An authentic frame says who made it, but not when: anyone can record a frame and send it again.
//! Every node therefore numbers its broadcasts by a [`Stamp`], (epoch, sequence), that never goes
//! back, because the epoch rises with every boot and survives it. A receiver believes a frame whose
//! stamp is greater than any it has believed of the same sender.
//!
//! A receiver that has just started has believed nothing yet. It broadcasts a hello, and each
//! neighbour answers with a sync that repeats the epoch of the hello. No such answer can have been
//! recorded before, since the epoch is new; so the answer's stamp is recent, and from then on the
//! rule above holds. Until then a neighbour's frames are refused.
//!
//! | of a neighbour | estimate, farewell or sync for another | hello | sync for this agent |
//! | --- | --- | --- | --- |
//! | not believed yet | refused | answered | believed if it repeats an epoch of this boot |
//! | believed | believed if its stamp is greater | answered unless its epoch is lower | likewise |
//!
//! Hellos are repeated while a neighbour is not believed, and answered at most once per
//! [`TrustParams::answer_gap`], so that a stranger who repeats a recorded hello costs little.
//!
//! The epoch also rises when the sequence starts again without a boot, as after a restart of the
//! agent, and when the sequence is used up. Epochs up to the field `epochs_end` have been reserved in
//! the store before the first is used; a node without a reserved epoch only listens.
//!
//! Memory: 40 bytes per neighbour and 64 bytes. Cost: that of a tag, and a search among the neighbours.
//! Invariant: of two frames made with the same key, the later one has the greater stamp; a frame is
//! believed at most once.

use crate::observer::feedback::Neighbour;
use crate::wire::authentic::{self, Bytes, Header, Kind, NetworkKey, Stamp};
use crate::wire::frame::{Frame, FrameError};
use crate::{AgentId, Tick};

/// How often hellos are sent and answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrustParams {
    /// Time between two hellos while a neighbour is not believed. \[ticks\]
    pub hello_interval: Tick,
    /// Least time between two answers to the same neighbour. \[ticks\]
    pub answer_gap: Tick,
}

/// What a node knows of a neighbour.
#[derive(Clone, Copy, Debug, Default)]
struct Peer {
    id: AgentId,
    /// The greatest stamp believed.
    believed: Option<Stamp>,
    /// The epoch of a hello that has not been answered yet.
    asks: Option<u32>,
    /// When a hello was answered last.
    answered: Option<Tick>,
}

/// Whom a node believes, and its own stamps. `NEIGHBOURS` is the largest number of neighbours.
#[derive(Clone, Debug)]
pub struct Trust<const NEIGHBOURS: usize> {
    params: TrustParams,
    own: AgentId,
    /// The first epoch of this boot, the one in use, and the end of those reserved.
    boot_epoch: u32,
    epoch: u32,
    epochs_end: u32,
    /// The sequence of the last estimate sealed in `epoch`.
    sealed: Option<u32>,
    last_hello: Option<Tick>,
    peers: heapless::Vec<Peer, NEIGHBOURS>,
}

impl<const NEIGHBOURS: usize> Trust<NEIGHBOURS> {
    /// Creates the state of the agent `own` after a boot: nothing is believed yet. The epochs from
    /// `first` up to, but excluding, `end` have been reserved in the store, read back, and never been
    /// used before; there may be none.
    #[must_use]
    pub fn new(own: AgentId, (first, end): (u32, u32), params: TrustParams) -> Self {
        Self {
            params,
            own,
            boot_epoch: first,
            epoch: first,
            epochs_end: end,
            sealed: None,
            last_hello: None,
            peers: heapless::Vec::new(),
        }
    }

    /// Makes these the agent's neighbours, and sets how often hellos are sent and answered. Those that
    /// were neighbours before stay believed. For new ones the agent continues in another epoch, since
    /// answers to its hellos of this one may have been recorded. Returns whether there is room.
    pub fn set_neighbours(&mut self, neighbours: &[Neighbour], params: TrustParams) -> bool {
        self.params = params;
        let before = core::mem::take(&mut self.peers);
        let mut is_new = false;
        for neighbour in neighbours {
            let known = before.iter().find(|peer| peer.id == neighbour.id).copied();
            is_new |= known.is_none();
            let peer = known.unwrap_or(Peer { id: neighbour.id, ..Peer::default() });
            if self.peers.push(peer).is_err() {
                return false;
            }
        }
        if is_new && self.last_hello.is_some() {
            self.epoch = self.epoch.saturating_add(1).min(self.epochs_end);
            (self.boot_epoch, self.sealed, self.last_hello) = (self.epoch, None, None);
        }
        true
    }

    /// Returns the number of epochs left, including the one in use.
    #[must_use]
    pub fn epochs_left(&self) -> u32 {
        self.epochs_end.saturating_sub(self.epoch)
    }

    /// Continues with the epochs from `first` up to, but excluding, `end`, which have been reserved in the
    /// store and read back; all are greater than the previous ones.
    pub fn extend(&mut self, (first, end): (u32, u32)) {
        if first >= self.epochs_end {
            if self.epoch >= self.epochs_end {
                // Nothing has been said in this boot that could be answered.
                self.boot_epoch = first;
            }
            if self.epoch >= self.epochs_end || first > self.epochs_end {
                (self.epoch, self.sealed) = (first, None);
            }
            self.epochs_end = end;
        }
    }

    /// Returns the agent that speaks.
    #[must_use]
    pub fn own(&self) -> AgentId {
        self.own
    }

    /// Returns whether the neighbour in this place, in the order of the parameters, is believed.
    #[must_use]
    pub fn is_believed(&self, place: usize) -> bool {
        self.peers.get(place).is_some_and(|peer| peer.believed.is_some())
    }

    /// Returns the bytes of a broadcast of the observer, or `None` if the node may only listen.
    pub fn seal<const N: usize>(&mut self, frame: &Frame<N>, key: &NetworkKey) -> Option<Bytes> {
        // Raised if the sequence starts again.
        let epoch = match self.sealed {
            Some(last) if frame.sequence <= last => self.epoch.checked_add(1)?,
            _ => self.epoch,
        };
        if epoch >= self.epochs_end {
            return None;
        }
        (self.epoch, self.sealed) = (epoch, Some(frame.sequence));
        let stamp = Stamp { epoch, sequence: frame.sequence };
        Some(frame.with_content(|payload, words| {
            self.bytes(stamp, frame.tick, Kind::broadcast(payload), words, key)
        }))
    }

    /// Returns a hello if one is due at the receiver's tick `now`.
    pub fn hello(&mut self, now: Tick, key: &NetworkKey) -> Option<Bytes> {
        let is_early = |last| now.saturating_sub(last) < self.params.hello_interval;
        if self.peers.iter().all(|peer| peer.believed.is_some())
            || self.epoch >= self.epochs_end
            || self.last_hello.is_some_and(is_early)
        {
            return None;
        }
        self.last_hello = Some(now);
        let stamp = Stamp { epoch: self.epoch, sequence: self.sealed.unwrap_or(0) };
        Some(self.bytes(stamp, now, Kind::Hello, &[], key))
    }

    /// Returns the answer to a hello if one is due at the receiver's tick `now`. `last` is the
    /// agent's last broadcast.
    pub fn answer<const N: usize>(
        &mut self,
        last: &Frame<N>,
        now: Tick,
        key: &NetworkKey,
    ) -> Option<Bytes> {
        // The last broadcast must have been sealed: its stamp is part of the answer.
        let sequence = self.sealed.filter(|&sealed| sealed == last.sequence)?;
        let (to, epoch) = self.asking(now)?;
        let stamp = Stamp { epoch: self.epoch, sequence };
        Some(last.with_content(|payload, words| {
            self.bytes(stamp, last.tick, Kind::answer(payload, to, epoch), words, key)
        }))
    }

    /// Returns whether a hello waits, but the agent has not said anything in its epoch: it must then
    /// broadcast its last sample again before it can answer.
    #[must_use]
    pub fn must_speak(&self) -> bool {
        self.sealed.is_none() && self.peers.iter().any(|peer| peer.asks.is_some())
    }

    /// Takes the next neighbour to answer, and the epoch of its hello.
    fn asking(&mut self, now: Tick) -> Option<(AgentId, u32)> {
        let gap = self.params.answer_gap;
        self.peers.iter_mut().find_map(|peer| {
            let is_early = peer.answered.is_some_and(|last| now.saturating_sub(last) < gap);
            let epoch = peer.asks.filter(|_| !is_early)?;
            (peer.asks, peer.answered) = (None, Some(now));
            Some((peer.id, epoch))
        })
    }

    /// Opens the frame in `bytes` with one of `keys` and believes it or not. Returns a sample that is
    /// newer than all earlier ones from its sender, or `None` for what is nothing to the observer: a hello,
    /// or a sync without news.
    ///
    /// # Errors
    /// Same as for [`authentic::open`] and [`Frame::decode`]; [`FrameError::UnknownSender`],
    /// [`FrameError::NotBelieved`] or [`FrameError::Replayed`].
    pub fn open<const N: usize>(
        &mut self,
        keys: &[NetworkKey],
        bytes: &[u8],
    ) -> Result<Option<Frame<N>>, FrameError> {
        let (header, words) = authentic::open(bytes, keys)?;
        let Header { sender, stamp, tick, kind } = header;
        let frame = kind
            .payload()
            .map(|payload| Frame::of_content((sender, stamp.sequence, tick), payload, words));
        let frame = frame.transpose()?;
        let is_new = self.believe(&header)?;
        Ok(frame.filter(|_| is_new))
    }

    /// Believes an authentic frame or not; returns whether it has a new sample.
    #[inline(never)]
    fn believe(&mut self, header: &Header) -> Result<bool, FrameError> {
        let &Header { sender, stamp, kind, .. } = header;
        let unknown = FrameError::UnknownSender { sender };
        let replayed = FrameError::Replayed { sender };
        // A node without a reserved epoch has said nothing that could be answered.
        let own_epochs = self.boot_epoch..self.epoch.saturating_add(1).min(self.epochs_end);
        let peer = self.peers.iter_mut().find(|peer| peer.id == sender).ok_or(unknown)?;
        if kind == Kind::Hello {
            if peer.believed.is_some_and(|believed| stamp.epoch < believed.epoch) {
                return Err(replayed);
            }
            peer.asks = peer.asks.max(Some(stamp.epoch));
            return Ok(false);
        }
        if let Some((to, epoch)) = kind.answered() {
            if peer.believed == Some(stamp) {
                return Ok(false);
            }
            if to == self.own {
                if !own_epochs.contains(&epoch) {
                    return Err(replayed);
                }
                // The first stamp: recent, because the answer repeats an epoch of this boot.
                if peer.believed.is_none() {
                    peer.believed = Some(stamp);
                    return Ok(true);
                }
            }
        }
        let believed = peer.believed.ok_or(FrameError::NotBelieved { sender })?;
        if stamp <= believed {
            return Err(replayed);
        }
        peer.believed = Some(stamp);
        Ok(true)
    }

    fn bytes(
        &self,
        stamp: Stamp,
        tick: Tick,
        kind: Kind,
        words: &[[u8; 4]],
        key: &NetworkKey,
    ) -> Bytes {
        authentic::seal(&Header { sender: self.own, stamp, tick, kind }, words, key)
    }
}

#[cfg(test)]
mod tests;
