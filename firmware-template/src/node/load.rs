//! Loads the package in use and prepares a session with it.

use agent_core::agent::AgentParams;
use agent_core::agent::region::StateBox;
use agent_core::health::trial::SECONDS_MIN;
use agent_core::health::{HealthParams, Performance};
use agent_core::observer::feedback::Neighbour;
use agent_core::observer::network::Scratch;
use agent_core::package::signature::PublicKey;
use agent_core::package::{
    AgentConfig, Capacity, Envelope, NetworkPlace, Package, ParamsPlace, Refusal, Requirements,
    Serial, TrialLimits, accept, accept_header,
};
use agent_core::service::RefusalReport;
use agent_core::store::{self, Change, MappedFlash, Store};
use agent_core::{AgentId, StateVector};

use super::limits::take;
use super::{Agent, Counts, Guard, InUsePackage, Memory, Node, Session, Settings};
use crate::board::Board;

impl<
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const SAMPLES: usize,
> Node<'_, F, N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// `Gamma` stays in the package and needs no buffer.
    const CAPACITY: Capacity = Capacity {
        features: FEATURES,
        neighbours: NEIGHBOURS,
        gain_entries: usize::MAX,
        known_inputs: 0,
    };

    /// Reads the journal and loads the package in flash, after all checks.
    #[inline(never)]
    pub(super) fn load(&mut self) {
        let Self { store, memory, settings, guard, .. } = self;
        store.read();
        guard.load(store, settings);
        let requirements = Self::required(settings, guard.operators(settings), guard.agent(), None);
        let mut check = |bytes: &[u8]| verified::<N>(bytes, &requirements, &mut memory.scratch);
        let loaded = store.load(&mut check);
        self.refused_at_start = loaded.refusals.map(|refusal| {
            refusal.map(|refusal| match refusal {
                store::Refusal::Check(refusal) => RefusalReport::from(&refusal),
                _ => RefusalReport::SLOT,
            })
        });
        let found = loaded.in_use.or_else(|| {
            let length = |slot: &[u8]| u32::try_from(Envelope::length_in(slot)?).ok();
            store.salvage(length, check, |new: &Verified, old| new.serial > old.serial)
        });
        if let Some((_, package)) = &found {
            // A journal of format 1 does not say.
            store.raise_activated(package.serial);
        }
        self.in_use = found.and_then(|(slot, package)| package.in_slot(slot, store));
        self.boots = store.count_boot(self.settings.start.boots);
    }

    /// Stages the uploaded package if it passes all checks.
    pub(super) fn stage_upload(&mut self) -> Result<Verified, store::CheckedError<Refusal>> {
        let agent = self.agent();
        let Self { store, memory, settings, limits, guard, .. } = self;
        if store.is_complete() {
            take(&mut limits.checks, !memory.session.is_empty())?;
        }
        let requirements =
            Self::required(settings, guard.operators(settings), agent, store.activated());
        store.stage(|bytes| verified::<N>(bytes, &requirements, &mut memory.scratch))
    }

    /// Takes a part of an upload. Before anything is erased, its header is checked.
    pub(super) fn take_chunk<B: Board>(
        &mut self,
        board: &mut B,
        offset: u32,
        bytes: &[u8],
    ) -> Result<u32, store::CheckedError<Refusal>> {
        let agent = self.agent();
        let Self { store, memory, settings, limits, guard, counts, .. } = self;
        let highest = store.activated();
        store.write(offset, bytes, |header| {
            take(&mut limits.uploads, !memory.session.is_empty())?;
            let requirements = Self::required(settings, guard.operators(settings), agent, highest);
            // A package of format 1 is checked when it is complete.
            accept_header::<N>(header, &requirements).map_err(store::CheckedError::Refused)?;
            if F::STALLS {
                // Its first unit is erased now.
                memory.leave(guard, board, counts);
            }
            Ok(())
        })
    }

    /// Says farewell to the neighbours if this change makes the chip stall.
    pub(super) fn leave_for<B: Board>(&mut self, board: &mut B, change: Change) {
        if F::STALLS && self.store.is_to_erase(change) {
            let Self { memory, guard, counts, flash_used, .. } = self;
            *flash_used = true;
            memory.leave(guard, board, counts);
        }
    }

    /// Puts the staged package on trial if it still passes all checks, its signature included.
    pub(super) fn activate_staged(&mut self) -> Result<Verified, store::CheckedError<Refusal>> {
        let agent = self.agent();
        let Self { store, memory, settings, guard, .. } = self;
        let requirements =
            Self::required(settings, guard.operators(settings), agent, store.activated());
        let check = |bytes: &[u8]| verified::<N>(bytes, &requirements, &mut memory.scratch);
        store.activate(check, Verified::serials)
    }

    /// The agent that the node is, if that has been decided: packages of others are refused.
    fn agent(&self) -> Option<AgentId> {
        self.guard.agent().or(self.in_use.map(|package| package.agent))
    }

    /// What the node requires of the next package.
    pub(super) fn requirements(&self) -> Requirements<'_> {
        let operators = self.guard.operators(&self.settings);
        Self::required(&self.settings, operators, self.agent(), self.store.activated())
    }

    fn required<'s>(
        settings: &'s Settings,
        public_keys: &'s [PublicKey],
        agent: Option<AgentId>,
        highest: Option<Serial>,
    ) -> Requirements<'s> {
        Requirements {
            public_keys,
            agent,
            highest,
            step_range: settings.step_range,
            capacity: Self::CAPACITY,
        }
    }

    /// Prepares the agent for the package in use or the built-in agent; without either there is no
    /// session.
    #[inline(never)]
    pub(super) fn begin_session(&mut self) {
        let old = self.memory.session.pop().map(|session| session.params);
        let next = self.session_after(old.as_ref().map_or(&[], ParamsPlace::neighbours));
        if let Some(next) = next {
            // There is room: the old one has been taken out.
            let _ = self.memory.session.push(next);
        }
        match (self.memory.session.first(), &mut self.trial) {
            (Some(session), _) => {
                let seconds = self.settings.trial.seconds.unwrap_or(SECONDS_MIN);
                self.performance = Performance::new(seconds, session.params.step_size());
            }
            (None, Some(trial)) if self.store.is_on_trial() => {
                let _ = trial.unusable();
            }
            (None, _) => {}
        }
    }

    /// Prepares for the frames of the session's neighbours. Apart from [`Self::begin_session`], so that
    /// their stacks are not added.
    #[inline(never)]
    pub(super) fn prepare_guard(&mut self) {
        let Self { guard, store, settings, memory, .. } = self;
        if let Some(Session { agent, params, .. }) = memory.session.first() {
            guard.prepare((*agent, params.step_size()), params.neighbours(), store, settings);
        }
    }

    /// Creates the next session, for an agent that had the neighbours `old`.
    fn session_after(&mut self, old: &[Neighbour]) -> Option<Session<N, NEIGHBOURS>> {
        let slot = self.in_use.map(|package| package.slot);
        let bytes = slot.and_then(|slot| self.store.bytes(slot)).unwrap_or_default();
        // Loading, activating or reverting has just verified the checksum of the bytes.
        let package = Package::decode_unchanged(bytes).ok();
        let place = match &package {
            Some(package) => ParamsPlace::new(package, bytes),
            None => ParamsPlace::built_in(self.settings.fallback.as_ref()?),
        }
        .ok()?;
        let params = place.params(bytes)?;
        let unlimited = ([f32::MIN; N], [f32::MAX; N]);
        let unlimited = StateBox { low: &unlimited.0, high: &unlimited.1 };
        let (trained_box, interval_min) = package.as_ref().map_or((unlimited, 0.0), |package| {
            (package.trained_box, package.broadcast_interval_min)
        });
        let health_params =
            HealthParams::new(&params, &trained_box, interval_min, &self.settings.health).ok()?;

        let agent = &mut self.memory.agent;
        let switched = agent.begun
            && package.as_ref().is_some_and(|package| {
                agent.state.switch(old, &params, package, &mut agent.inbox).is_ok()
            });
        if !switched {
            let estimate =
                if agent.begun { *agent.state.estimate() } else { health_params.start_estimate() };
            let weights = package.as_ref().map_or(&[0.0; N][..], |package| package.outer_weights);
            agent.begun = agent.begin(&params, estimate, weights);
            agent.begun.then_some(())?;
            #[cfg(feature = "field")]
            {
                let words = package.as_ref().map_or(&[][..], |package| package.node.field);
                agent.state.set_field(&params, words).ok()?;
            }
        }
        let network = slot
            .zip(package)
            .and_then(|(slot, package)| Some((slot, NetworkPlace::new(&package, bytes)?)));
        Some(Session { agent: params.id(), params: place, health_params, network })
    }

    /// Restarts the agent from this estimate and informs its neighbours; returns whether this
    /// succeeded, `None` without an agent.
    pub(super) fn start_at<B: Board>(
        &mut self,
        board: &mut B,
        estimate: StateVector<N>,
    ) -> Option<bool> {
        let Self { store, memory, next_tick, counts, guard, .. } = self;
        let Memory { agent, session, .. } = &mut **memory;
        let session = session.first()?;
        let bytes = session.bytes(store);
        let params = session.params.params(bytes)?;
        let weights = session.outer_weights(bytes);
        let started = if agent.announced {
            let tick = next_tick.saturating_sub(1);
            let restarted = agent.state.restart(&params, tick, estimate, weights).is_ok();
            agent.announced = !restarted;
            restarted
        } else {
            agent.begin(&params, estimate, weights)
        };
        if started {
            agent.announce(&params, guard, board, counts);
        }
        Some(started)
    }
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize, const SAMPLES: usize>
    Memory<N, FEATURES, NEIGHBOURS, SAMPLES>
{
    /// Tells the neighbours that the chip is about to stall, if they know the agent.
    #[cfg(feature = "exchange")]
    #[inline(never)]
    fn leave<B: Board>(
        &mut self,
        guard: &mut Guard<NEIGHBOURS>,
        board: &mut B,
        counts: &mut Counts,
    ) {
        let Self { agent, session, .. } = self;
        if let Some(session) = session.first().filter(|_| agent.announced)
            && let Some(frame) = agent.state.farewell(session.agent)
            && let Err(kind) = guard.broadcast(&frame, board)
        {
            counts.not_sent(kind);
        }
    }

    /// Nothing: neighbours without the feature refuse such frames.
    #[cfg(not(feature = "exchange"))]
    #[expect(clippy::unused_self, reason = "as with the feature")]
    fn leave<B: Board>(&mut self, _: &mut Guard<NEIGHBOURS>, _: &mut B, _: &mut Counts) {}
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize>
    Agent<N, FEATURES, NEIGHBOURS>
{
    /// Initialises the agent as after power-on, except that a field observer stays in use; returns whether this
    /// succeeded.
    fn begin(
        &mut self,
        params: &AgentParams<'_, N>,
        estimate: StateVector<N>,
        outer_weights: &[f32],
    ) -> bool {
        let neighbours = params.neighbours().len();
        self.announced = false;
        self.state.places().resize(neighbours, None).is_ok()
            && self.inbox.places().resize(neighbours, None).is_ok()
            && self.state.begin_again(params, estimate, outer_weights).is_ok()
    }

    /// Sends the first sample to the neighbours, unless they already have it.
    pub(super) fn announce<B: Board>(
        &mut self,
        params: &AgentParams<'_, N>,
        guard: &mut Guard<NEIGHBOURS>,
        board: &mut B,
        counts: &mut Counts,
    ) {
        if !self.announced {
            self.announced = true;
            let frame = self.state.announcement(params);
            if let Err(kind) = guard.broadcast(&frame, board) {
                counts.not_sent(kind);
            }
        }
    }
}

impl<const N: usize, const NEIGHBOURS: usize> Session<N, NEIGHBOURS> {
    /// Returns the bytes of the package in use; empty for the built-in agent.
    #[inline]
    pub(super) fn bytes<'s, F: MappedFlash>(&self, store: &'s Store<F>) -> &'s [u8] {
        self.network.as_ref().and_then(|(slot, _)| store.bytes(*slot)).unwrap_or_default()
    }

    /// Returns the outer weights of the package in use, from its bytes.
    pub(super) fn outer_weights<'b>(&self, bytes: &'b [u8]) -> &'b [f32] {
        let package = self.network.as_ref().and_then(|(_, place)| place.outer_weights(bytes));
        package.unwrap_or(&[0.0; N])
    }
}

/// The properties of a verified package that are kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Verified {
    agent: AgentId,
    pub(super) serial: Serial,
    highest: Serial,
    /// CRC-32 of the output matrix.
    pub(super) outputs: u32,
    pub(super) step_size: f32,
    pub(super) trial: TrialLimits,
}

impl Verified {
    pub(super) fn of(package: &Package<'_>, requirements: &Requirements<'_>) -> Self {
        let AgentConfig { agent, step_size, .. } = package.node;
        let outputs = package.node.output_checksum();
        let (serial, trial) = (package.serial(), package.trial.unwrap_or(TrialLimits::NONE));
        let highest = requirements.serial_after_activation(package);
        Self { agent, serial, highest, outputs, step_size, trial }
    }

    /// Returns the serial of the package, and the highest one once it has been activated.
    pub(super) fn serials(&self) -> (Serial, Serial) {
        (self.serial, self.highest)
    }

    /// Returns `None` if no package is recorded in the slot.
    pub(super) fn in_slot<F: MappedFlash>(
        self,
        slot: store::Slot,
        store: &Store<F>,
    ) -> Option<InUsePackage> {
        let Self { agent, serial, outputs, step_size, .. } = self;
        let checksum = store.checksum(slot)?;
        Some(InUsePackage { agent, serial, checksum, outputs, step_size, slot })
    }
}

/// Performs all checks of a package.
#[inline(never)]
pub(super) fn verified<const N: usize>(
    bytes: &[u8],
    requirements: &Requirements<'_>,
    scratch: &mut Scratch,
) -> Result<Verified, Refusal> {
    accept::<N>(bytes, requirements, scratch).map(|package| Verified::of(&package, requirements))
}
