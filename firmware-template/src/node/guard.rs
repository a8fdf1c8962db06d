//! What keeps strangers out: the node's keys, its epochs, and which neighbours it believes.
//!
//! | the node has | frames | requests |
//! | --- | --- | --- |
//! | no key | of version 1 | all are carried out |
//! | a port key | of version 1 | sealed ones, and those that are free |
//! | network keys | of version 2; none are sent without a reserved epoch | as its port key says |
//! | a journal that cannot be read completely, and no port key in the rest | none | only free ones |
//!
//! A boot takes a few epochs, and a session of the service port lasts as long as a boot. Epochs are
//! reserved in flash for many boots at once; a board that keeps memory during a reset
//! ([`Settings::keep_epochs`]) uses them up, so that a loop of resets does not wear out the flash.
//!
//! Memory: 120 bytes, and 24 per neighbour.

use agent_core::agent::hold::HoldSlots;
use agent_core::agent::trust::{Trust, TrustParams};
use agent_core::health::WatchedAgent;
use agent_core::observer::feedback::Neighbour;
use agent_core::package::signature::{self, PublicKey};
use agent_core::package::{Envelope, Refusal, check_signature as check_package_signature};
use agent_core::service::seal::PortKey;
use agent_core::service::{Problem, Provision, RefusalReport, Session, split_seal};
use agent_core::store::{
    MappedFlash, NetworkKeys, OperatorKeys, Slot, Store, StoreError, network_keys, operator_keys,
};
use agent_core::wire::authentic::NetworkKey;
use agent_core::wire::frame::Frame;
use agent_core::{AgentId, Tick};

use super::{Epochs, Settings};
use crate::board::{Board, LinkErrorKind};

/// Number of epochs that a boot takes, and takes again when they run out: an agent that starts again
/// from its first broadcast needs one.
const TAKEN: u32 = 4;
/// Epochs reserved at once.
const RESERVED: u32 = 64;

/// The highest epoch with which a node can be provisioned: 4 million starts are left after it.
const EPOCH_MAX: u32 = 0xf000_0000;

/// Time between two hellos while a neighbour is not believed. \[s\]
const HELLO_INTERVAL: f32 = 0.5;
/// Least time between two answers to the hellos of one neighbour. \[s\]
const ANSWER_GAP: f32 = 0.2;

/// Keys, epochs, and whom the node believes.
#[derive(Debug)]
pub(super) struct Guard<const NEIGHBOURS: usize> {
    network: NetworkKeys,
    port: Option<(PortKey, AgentId)>,
    /// The first epoch of this boot, if the store could reserve one.
    epoch: Option<u32>,
    /// Epochs that this boot has reserved or taken over, and not taken yet.
    reserved: Epochs,
    trust: Option<Trust<NEIGHBOURS>>,
    /// The operator's public keys, none if packages need not be signed.
    operators: OperatorKeys,
    /// Counter of the last sealed request.
    counter: u32,
    /// Whether nothing in the journal could be read, and so perhaps keys: the node then neither hears nor
    /// answers its neighbours, and carries out free requests only.
    is_locked: bool,
}

impl<const NEIGHBOURS: usize> Guard<NEIGHBOURS> {
    pub(super) const fn new() -> Self {
        Self {
            network: NetworkKeys::new(),
            port: None,
            epoch: None,
            reserved: Epochs { next: 0, end: 0 },
            trust: None,
            operators: OperatorKeys::new(),
            counter: 0,
            is_locked: false,
        }
    }

    /// Reads the keys after a boot, and takes the boot's epochs.
    #[inline(never)]
    pub(super) fn load<F: MappedFlash>(&mut self, store: &mut Store<F>, settings: &Settings) {
        if settings.factory_reset {
            // Also if nothing in the journal can be read. If it fails, the port key is the last to go, and
            // the reset can be repeated.
            store.forget_unreadable();
            let _ = store.reset();
        }
        self.network = store.network_keys();
        self.port = store.port_key().map(|(secret, agent)| (PortKey::new(secret), agent));
        if let Some(built_in) = settings.public_key {
            self.operators = store.operator_keys(built_in);
        }
        self.is_locked = self.port.is_none() && store.is_blocked();
        self.reserved = settings.start.epochs;
        if store.epochs_end() != Ok(self.reserved.end) {
            self.reserved = Epochs::default();
        }
        if self.port.is_some() || !self.network.is_empty() {
            let _ = self.open(store, settings);
        }
    }

    /// Takes the boot's first epochs, if it has none.
    fn open<F: MappedFlash>(
        &mut self,
        store: &mut Store<F>,
        settings: &Settings,
    ) -> Result<(), StoreError> {
        if self.epoch.is_none() {
            // One more, for the sessions of the service port.
            self.epoch = Some(self.take(1, store, settings)?.next);
        }
        Ok(())
    }

    /// Takes epochs from those reserved.
    fn take<F: MappedFlash>(
        &mut self,
        count: u32,
        store: &mut Store<F>,
        settings: &Settings,
    ) -> Result<Epochs, StoreError> {
        if self.reserved.left() < count {
            let (next, end) = store.reserve_epochs(RESERVED)?;
            self.reserved = Epochs { next, end };
        }
        let next = self.reserved.next;
        self.reserved.next = next.saturating_add(count);
        if let Some(keep) = settings.keep_epochs {
            keep(self.reserved);
        }
        Ok(Epochs { next, end: self.reserved.next })
    }

    /// The agent that the node was provisioned as.
    pub(super) fn agent(&self) -> Option<AgentId> {
        self.port.as_ref().map(|&(_, agent)| agent)
    }

    /// The public keys, one of which must match a package's signature; empty if none is needed.
    pub(super) fn operators<'s>(&'s self, settings: &'s Settings) -> &'s [PublicKey] {
        match (&settings.public_key, self.operators.as_slice()) {
            (None, _) => &[],
            (built_in, []) => built_in.as_slice(),
            (_, operators) => operators,
        }
    }

    /// Prepares for an agent with this step and these neighbours.
    #[inline(never)]
    pub(super) fn prepare<F: MappedFlash>(
        &mut self,
        (own, step_size): (AgentId, f32),
        neighbours: &[Neighbour],
        store: &mut Store<F>,
        settings: &Settings,
    ) {
        if self.network.is_empty() {
            return;
        }
        // Without epochs the node only listens.
        let is_same = self.trust.as_ref().filter(|trust| trust.own() == own);
        let taken = match is_same {
            // One for other neighbours, one for an agent that starts again.
            Some(trust) if trust.epochs_left() > 2 => None,
            _ => self.take(TAKEN, store, settings).ok(),
        };
        let taken = taken.map(|epochs| (epochs.next, epochs.end));
        let ticks = |seconds: f32| Tick::from(((seconds / step_size) as u32).max(1));
        let (hello_interval, answer_gap) = (ticks(HELLO_INTERVAL), ticks(ANSWER_GAP));
        let params = TrustParams { hello_interval, answer_gap };
        match (&mut self.trust, taken) {
            (Some(trust), Some(taken)) if trust.own() == own => trust.extend(taken),
            (Some(trust), _) if trust.own() == own => {}
            (trust, taken) => *trust = Some(Trust::new(own, taken.unwrap_or((0, 0)), params)),
        }
        if let Some(trust) = &mut self.trust {
            // A package with more neighbours than the node has room for is not accepted.
            let _ = trust.set_neighbours(neighbours, params);
        }
    }

    /// Keeps a received frame for the next step, or counts why it was refused.
    pub(super) fn receive<const N: usize, const FEATURES: usize, S, I>(
        &mut self,
        watched: &mut WatchedAgent<'_, N, FEATURES, S, I>,
        bytes: &[u8],
    ) where
        S: HoldSlots<N>,
        I: HoldSlots<N>,
    {
        let Some(trust) = &mut self.trust else {
            if self.network.is_empty() && !self.is_locked {
                let _ = watched.receive(bytes);
            }
            return;
        };
        match trust.open(&self.network, bytes) {
            Ok(Some(frame)) => {
                let _ = watched.receive_believed(&frame);
            }
            Ok(None) => {}
            Err(error) => watched.health.frame_refused(&error),
        }
    }

    /// Broadcasts a frame of the observer, unless the node may only listen.
    pub(super) fn broadcast<const N: usize, B: Board>(
        &mut self,
        frame: &Frame<N>,
        board: &mut B,
    ) -> Result<(), LinkErrorKind> {
        if self.is_locked {
            return Ok(());
        }
        let Some(key) = self.network.first() else { return board.broadcast(&frame.encode()) };
        match self.trust.as_mut().and_then(|trust| trust.seal(frame, key)) {
            Some(bytes) => board.broadcast(&bytes),
            None => Ok(()),
        }
    }

    /// Sends a hello and an answer if they are due. `last` is the agent's last broadcast.
    pub(super) fn greet<const N: usize, B: Board>(
        &mut self,
        last: &Frame<N>,
        now: Tick,
        board: &mut B,
    ) -> Result<(), LinkErrorKind> {
        let (Some(trust), Some(key)) = (&mut self.trust, self.network.first()) else {
            return Ok(());
        };
        if let Some(bytes) = trust.hello(now, key) {
            board.broadcast(&bytes)?;
        }
        if trust.must_speak()
            && let Some(bytes) = trust.seal(last, key)
        {
            board.broadcast(&bytes)?;
        }
        match trust.answer(last, now, key) {
            Some(bytes) => board.broadcast(&bytes),
            None => Ok(()),
        }
    }

    /// Opens a request in place; returns whether it was sealed, and the request.
    #[inline(never)]
    pub(super) fn open_request<'b>(
        &mut self,
        bytes: &'b mut [u8],
    ) -> Result<(bool, &'b [u8]), Problem> {
        let (seal, sealed) = split_seal(bytes);
        let Some(seal) = seal else { return Ok((false, bytes)) };
        let start = bytes.len() - sealed.len();
        let (key, _) = self.port.as_ref().ok_or(Problem::NotProvisioned)?;
        let epoch = self.epoch.filter(|_| seal.counter > self.counter).ok_or(Problem::Seal)?;
        let sealed = bytes.get_mut(start..).ok_or(Problem::Seal)?;
        let request = key.open(epoch, &seal, sealed).ok_or(Problem::Seal)?;
        self.counter = seal.counter;
        Ok((true, request))
    }

    /// Refuses what strangers may not ask for.
    pub(super) fn admit(&self, is_sealed: bool, is_free: bool) -> Result<(), Problem> {
        if (self.port.is_some() || self.is_locked) && !is_sealed && !is_free {
            return Err(Problem::NotSealed);
        }
        Ok(())
    }

    pub(super) fn session(&self) -> Option<Session> {
        let (key, agent) = self.port.as_ref()?;
        let number = |place: usize| self.network.get(place).map(NetworkKey::number);
        let session = Session {
            agent: *agent,
            epoch: self.epoch,
            counter: self.counter,
            proof: 0,
            network_keys: [number(0), number(1)],
        };
        Some(Session { proof: key.proof(&session), ..session })
    }

    /// Records port key and agent. The first ones need a signature if packages do. The caller then
    /// prepares for the agent again.
    #[inline(never)]
    pub(super) fn provision<F: MappedFlash>(
        &mut self,
        bytes: &[u8],
        store: &mut Store<F>,
        settings: &Settings,
    ) -> Result<(), Problem> {
        let (provision, signature) = Provision::split(bytes).ok_or(Problem::Unknown)?;
        if self.port.is_none()
            && let operators @ [_, ..] = self.operators(settings)
        {
            check_signature(operators, &provision.signed_bytes(), signature)?;
        }
        // Enough must be left for every start of a long life.
        if provision.epoch > EPOCH_MAX {
            return Err(StoreError::Note.into());
        }
        if provision.epoch > store.epochs_end()? {
            store.skip_epochs(provision.epoch)?;
            // What was sealed in the epochs of an image that is written again is worth nothing.
            (self.reserved, self.epoch, self.trust) = (Epochs::default(), None, None);
        }
        self.open(store, settings)?;
        store.record_port_key(provision.port_key, provision.agent)?;
        self.port = Some((PortKey::new(provision.port_key), provision.agent));
        Ok(())
    }

    /// Records network keys. The caller then prepares for the agent again.
    #[inline(never)]
    pub(super) fn replace_network_keys<F: MappedFlash>(
        &mut self,
        bytes: &[u8],
        store: &mut Store<F>,
    ) -> Result<(), Problem> {
        if self.port.is_none() {
            return Err(Problem::NotProvisioned);
        }
        store.record_network_keys(bytes)?;
        self.network = network_keys(bytes);
        Ok(())
    }

    /// Records the operator's public keys, unless the package in use is not signed with any of them: the
    /// next boot would refuse it.
    pub(super) fn replace_operators<F: MappedFlash>(
        &mut self,
        bytes: &[u8],
        in_use: Option<Slot>,
        store: &mut Store<F>,
        settings: &Settings,
    ) -> Result<(), Problem> {
        let Some(built_in) = settings.public_key else { return Err(Problem::Unknown) };
        self.record_operators(bytes, built_in, in_use, store)
    }

    #[inline(never)]
    fn record_operators<F: MappedFlash>(
        &mut self,
        bytes: &[u8],
        built_in: PublicKey,
        in_use: Option<Slot>,
        store: &mut Store<F>,
    ) -> Result<(), Problem> {
        if self.port.is_none() {
            return Err(Problem::NotProvisioned);
        }
        let operators = operator_keys(bytes, built_in)?;
        if let Some(package) = in_use.and_then(|slot| store.bytes(slot)) {
            let checked = Envelope::open(package)
                .map_err(Refusal::from)
                .and_then(|envelope| check_package_signature(&envelope, &operators));
            checked.map_err(|refusal| Problem::Package(RefusalReport::from(&refusal)))?;
        }
        store.record_operator_keys(bytes)?;
        self.operators = operators;
        Ok(())
    }

    /// Makes the node blank, except for its epochs and the highest package activated.
    pub(super) fn reset<F: MappedFlash>(&self, store: &mut Store<F>) -> Result<(), Problem> {
        if self.port.is_none() {
            return Err(Problem::NotProvisioned);
        }
        Ok(store.reset()?)
    }
}

/// Checks that one of the operators has signed this.
fn check_signature(
    operators: &[PublicKey],
    signed: &[u8],
    signature: &[u8],
) -> Result<(), Problem> {
    let signature = signature.try_into().map_err(|_| Problem::NotSigned)?;
    let matches = |key| signature::verify(key, signed, signature).is_ok();
    if operators.iter().any(matches) { Ok(()) } else { Err(Problem::NotSigned) }
}
