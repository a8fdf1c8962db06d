//! A node without the feature `authentic-frames`: it has no keys, speaks frames of version 1, and
//! carries out every request.

use agent_core::agent::hold::HoldSlots;
use agent_core::health::WatchedAgent;
use agent_core::observer::feedback::Neighbour;
use agent_core::package::signature::PublicKey;
use agent_core::service::{Problem, Session};
use agent_core::store::{MappedFlash, Slot, Store};
use agent_core::wire::frame::Frame;
use agent_core::{AgentId, Tick};

use super::Settings;
use crate::board::{Board, LinkErrorKind};

/// Nothing: see the module of the same name with the feature.
#[derive(Debug)]
pub(super) struct Guard<const NEIGHBOURS: usize>;

#[expect(clippy::unused_self, reason = "as with the feature")]
impl<const NEIGHBOURS: usize> Guard<NEIGHBOURS> {
    pub(super) const fn new() -> Self {
        Self
    }

    pub(super) fn load<F: MappedFlash>(&mut self, _: &mut Store<F>, _: &Settings) {}

    pub(super) fn agent(&self) -> Option<AgentId> {
        None
    }

    pub(super) fn operators<'s>(&self, settings: &'s Settings) -> &'s [PublicKey] {
        settings.public_key.as_slice()
    }

    pub(super) fn prepare<F: MappedFlash>(
        &mut self,
        _: (AgentId, f32),
        _: &[Neighbour],
        _: &mut Store<F>,
        _: &Settings,
    ) {
    }

    pub(super) fn receive<const N: usize, const FEATURES: usize, S, I>(
        &mut self,
        watched: &mut WatchedAgent<'_, N, FEATURES, S, I>,
        bytes: &[u8],
    ) where
        S: HoldSlots<N>,
        I: HoldSlots<N>,
    {
        // Refusals are counted.
        let _ = watched.receive(bytes);
    }

    pub(super) fn broadcast<const N: usize, B: Board>(
        &mut self,
        frame: &Frame<N>,
        board: &mut B,
    ) -> Result<(), LinkErrorKind> {
        board.broadcast(&frame.encode())
    }

    pub(super) fn greet<const N: usize, B: Board>(
        &mut self,
        _: &Frame<N>,
        _: Tick,
        _: &mut B,
    ) -> Result<(), LinkErrorKind> {
        Ok(())
    }

    pub(super) fn open_request<'b>(
        &mut self,
        bytes: &'b mut [u8],
    ) -> Result<(bool, &'b [u8]), Problem> {
        Ok((false, bytes))
    }

    pub(super) fn admit(&self, _: bool, _: bool) -> Result<(), Problem> {
        Ok(())
    }

    pub(super) fn session(&self) -> Option<Session> {
        None
    }

    pub(super) fn provision<F: MappedFlash>(
        &mut self,
        _: &[u8],
        _: &mut Store<F>,
        _: &Settings,
    ) -> Result<(), Problem> {
        Err(Problem::Unknown)
    }

    pub(super) fn replace_network_keys<F: MappedFlash>(
        &mut self,
        _: &[u8],
        _: &mut Store<F>,
    ) -> Result<(), Problem> {
        Err(Problem::Unknown)
    }

    pub(super) fn replace_operators<F: MappedFlash>(
        &mut self,
        _: &[u8],
        _: Option<Slot>,
        _: &mut Store<F>,
        _: &Settings,
    ) -> Result<(), Problem> {
        Err(Problem::Unknown)
    }

    pub(super) fn reset<F: MappedFlash>(&self, _: &mut Store<F>) -> Result<(), Problem> {
        Err(Problem::Unknown)
    }
}
