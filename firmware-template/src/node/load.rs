//! Which package is in use, and what a session takes from it.

use agent_core::StateVector;
use agent_core::agent::AgentParams;
use agent_core::agent::region::StateBox;
use agent_core::health::HealthParams;
use agent_core::observer::feedback::Neighbour;
use agent_core::observer::network::Scratch;
use agent_core::package::{
    AgentConfig, Capacity, Envelope, InUse, NetworkPlace, Package, Refusal, Requirements, accept,
};
use agent_core::service::RefusalReport;
use agent_core::store::{self, MappedFlash, Store};

use super::{Agent, InUsePackage, Node, ParamBuffers, Session};

impl<
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const GAINS: usize,
    const SAMPLES: usize,
> Node<'_, F, N, FEATURES, NEIGHBOURS, GAINS, SAMPLES>
{
    const CAPACITY: Capacity =
        Capacity { features: FEATURES, neighbours: NEIGHBOURS, gain_entries: GAINS };

    /// Takes what the flash holds into use, after all checks.
    pub(super) fn load(&mut self) {
        let Self { store, memory, settings, .. } = self;
        let requirements = Requirements {
            public_key: settings.public_key.as_ref(),
            in_use: None,
            capacity: Self::CAPACITY,
        };
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
            store.salvage(length, check, |new: &Verified, old| new.version > old.version)
        });
        self.in_use = found.and_then(|(slot, package)| package.in_slot(slot, store));
    }

    /// Lets the upload become the staged package, if it passes all checks.
    pub(super) fn stage_upload(&mut self) -> Result<Verified, store::CheckedError<Refusal>> {
        let Self { store, memory, settings, in_use, .. } = self;
        let requirements = Requirements {
            public_key: settings.public_key.as_ref(),
            in_use: in_use.map(|package| InUse { agent: package.agent, version: package.version }),
            capacity: Self::CAPACITY,
        };
        store.stage(|bytes| verified::<N>(bytes, &requirements, &mut memory.scratch))
    }

    /// Prepares the agent for what is in use, which follows on an agent with the neighbours `old`.
    /// `None` if nothing is in use and nothing is built in.
    #[inline(never)]
    pub(super) fn begin_session<'a>(
        &mut self,
        places: &'a mut ParamBuffers<NEIGHBOURS, GAINS>,
        old: &[Neighbour],
    ) -> Option<Session<'a, N>> {
        let ParamBuffers { neighbours, gain } = places;
        let slot = self.in_use.map(|package| package.slot);
        let bytes = slot.and_then(|slot| self.store.bytes(slot));
        // Loading, activating or reverting has just compared the bytes with a checksum.
        let package = bytes.and_then(|bytes| Package::decode_unchanged(bytes).ok());
        let content = package.as_ref().map(|package| package.node).or(self.settings.fallback)?;
        let params = content.params::<N>(neighbours, gain).ok()?;
        let unlimited = ([f32::MIN; N], [f32::MAX; N]);
        let unlimited = StateBox { low: &unlimited.0, high: &unlimited.1 };
        let (trained_box, interval_min) = package.as_ref().map_or((unlimited, 0.0), |package| {
            (package.trained_box, package.broadcast_interval_min)
        });
        let watch =
            HealthParams::new(&params, &trained_box, interval_min, &self.settings.health).ok()?;

        let agent = &mut self.memory.agent;
        let switched = agent.begun
            && package.as_ref().is_some_and(|package| {
                agent.state.switch(old, &params, package, &mut agent.inbox).is_ok()
            });
        if !switched {
            let estimate =
                if agent.begun { *agent.state.estimate() } else { watch.start_estimate() };
            let weights = package.as_ref().map_or(&[0.0; N][..], |package| package.outer_weights);
            agent.begun = agent.begin(&params, estimate, weights);
            agent.begun.then_some(())?;
        }
        let network = slot
            .zip(bytes.zip(package))
            .and_then(|(slot, (bytes, package))| Some((slot, NetworkPlace::new(&package, bytes)?)));
        Some(Session { params, watch, network })
    }

    /// Lets the agent go on from this estimate; returns whether it could.
    pub(super) fn start_at(&mut self, session: &Session<'_, N>, estimate: StateVector<N>) -> bool {
        let Self { store, memory, next_tick, .. } = self;
        let zeros = [0.0; N];
        let weights = session.outer_weights(store).unwrap_or(&zeros);
        let agent = &mut memory.agent;
        if agent.announced {
            let tick = next_tick.saturating_sub(1);
            let restarted = agent.state.restart(&session.params, tick, estimate, weights).is_ok();
            agent.announced = !restarted;
            restarted
        } else {
            agent.begin(&session.params, estimate, weights)
        }
    }
}

impl<const N: usize, const FEATURES: usize, const NEIGHBOURS: usize>
    Agent<N, FEATURES, NEIGHBOURS>
{
    /// Begins as after switching on; returns whether it could.
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
            && self.state.begin(params, estimate, outer_weights).is_ok()
    }
}

impl<const N: usize> Session<'_, N> {
    /// The outer weights that the package in use brings along.
    pub(super) fn outer_weights<'s, F: MappedFlash>(
        &self,
        store: &'s Store<F>,
    ) -> Option<&'s [f32]> {
        let (slot, place) = self.network.as_ref()?;
        place.outer_weights(store.bytes(*slot)?)
    }
}

/// What is left of a package once it has been verified.
#[derive(Clone, Copy, Debug)]
pub(super) struct Verified {
    agent: agent_core::AgentId,
    pub(super) version: u32,
    step_size: f32,
}

impl Verified {
    pub(super) fn of(package: &Package<'_>) -> Self {
        let AgentConfig { agent, step_size, .. } = package.node;
        Self { agent, version: package.version, step_size }
    }

    /// `None` if nothing is recorded in the slot.
    pub(super) fn in_slot<F: MappedFlash>(
        self,
        slot: store::Slot,
        store: &Store<F>,
    ) -> Option<InUsePackage> {
        let Self { agent, version, step_size } = self;
        Some(InUsePackage { agent, version, checksum: store.checksum(slot)?, step_size, slot })
    }
}

/// All that a package has to pass.
#[inline(never)]
pub(super) fn verified<const N: usize>(
    bytes: &[u8],
    requirements: &Requirements<'_>,
    scratch: &mut Scratch,
) -> Result<Verified, Refusal> {
    accept::<N>(bytes, requirements, scratch).map(|package| Verified::of(&package))
}
