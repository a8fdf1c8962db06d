//! Which package is in use, and what a session takes from it.

use agent_core::StateVector;
use agent_core::agent::AgentState;
use agent_core::checksum::crc32;
use agent_core::health::HealthParams;
use agent_core::inbox::Inbox;
use agent_core::network::Scratch;
use agent_core::observer::Neighbour;
use agent_core::package::{
    Capacity, Envelope, InUse, NetworkPlace, Package, PackageError, Refusal, Requirements,
    StateBox, accept,
};
use agent_core::service::RefusalReport;
use agent_core::store::{self, MappedFlash};

use super::{Agent, Holds, InUsePackage, Node, Places, Session};

impl<
    F: MappedFlash,
    const N: usize,
    const FEATURES: usize,
    const NEIGHBOURS: usize,
    const GAINS: usize,
    const SAMPLES: usize,
> Node<F, N, FEATURES, NEIGHBOURS, GAINS, SAMPLES>
{
    const CAPACITY: Capacity =
        Capacity { features: FEATURES, neighbours: NEIGHBOURS, gain_entries: GAINS };

    /// Takes what the flash holds into use, after all checks.
    pub(super) fn load(&mut self) {
        let requirements = Requirements {
            public_key: self.settings.public_key.as_ref(),
            in_use: None,
            capacity: Self::CAPACITY,
        };
        let mut check = |bytes: &[u8]| verified::<N>(bytes, &requirements);
        let loaded = self.store.load(&mut check);
        self.refused_at_start = loaded.refusals.map(|refusal| {
            refusal.map(|refusal| match refusal {
                store::Refusal::Check(refusal) => RefusalReport::from(&refusal),
                _ => RefusalReport::SLOT,
            })
        });
        let found = loaded.in_use.or_else(|| {
            let length = |slot: &[u8]| u32::try_from(Envelope::length_in(slot)?).ok();
            self.store.salvage(length, check, |new: &Verified, old| new.version > old.version)
        });
        self.in_use = found.map(|(slot, package)| package.in_slot(slot));
    }

    /// The check that a package has to pass before it is staged.
    pub(super) fn requirements(&self) -> Requirements<'_> {
        Requirements {
            public_key: self.settings.public_key.as_ref(),
            in_use: self
                .in_use
                .map(|package| InUse { agent: package.agent, version: package.version }),
            capacity: Self::CAPACITY,
        }
    }

    /// Prepares the agent for what is in use, which follows on an agent with the neighbours `old`.
    /// `None` if nothing is in use and nothing is built in.
    pub(super) fn begin_session<'a>(
        &mut self,
        places: &'a mut Places<NEIGHBOURS, GAINS>,
        old: &[Neighbour],
    ) -> Option<Session<'a, N>> {
        let Places { neighbours, gain } = places;
        let slot = self.in_use.map(|package| package.slot);
        let bytes = slot.and_then(|slot| self.store.bytes(slot));
        let package = bytes.and_then(|bytes| Package::decode(bytes).ok());
        let content = package.as_ref().map(|package| package.node).or(self.settings.fallback)?;
        let params = content.params::<N>(neighbours, gain).ok()?;
        let unlimited = ([f32::MIN; N], [f32::MAX; N]);
        let unlimited = StateBox { low: &unlimited.0, high: &unlimited.1 };
        let (trained_box, interval_min) = package.as_ref().map_or((unlimited, 0.0), |package| {
            (package.trained_box, package.broadcast_interval_min)
        });
        let watch =
            HealthParams::new(&params, &trained_box, interval_min, &self.settings.health).ok()?;

        let switched = match (&mut self.agent, &package) {
            (Some(agent), Some(package)) => {
                agent.state.switch(old, &params, package, &mut agent.inbox).is_ok()
            }
            _ => false,
        };
        if !switched {
            let estimate = match &self.agent {
                Some(agent) => *agent.state.estimate(),
                None => watch.start_estimate(),
            };
            let zeros = [0.0; N];
            let outer_weights =
                package.as_ref().map_or(&zeros[..], |package| package.outer_weights);
            let mut holds = Holds::<N, NEIGHBOURS>::new();
            holds.resize(params.neighbours().len(), None).ok()?;
            let state = AgentState::new(&params, estimate, outer_weights, holds.clone()).ok()?;
            self.agent = Some(Agent { state, inbox: Inbox::new(holds), announced: false });
        }
        let network = slot
            .zip(bytes.zip(package))
            .and_then(|(slot, (bytes, package))| Some((slot, NetworkPlace::new(&package, bytes)?)));
        Some(Session { params, watch, network })
    }

    /// Lets the agent begin with this estimate; returns whether it could.
    pub(super) fn start_at(&mut self, session: &Session<'_, N>, estimate: StateVector<N>) -> bool {
        let tick = self.next_tick;
        let Some(agent) = &mut self.agent else { return false };
        let weights = match &session.network {
            Some((slot, _)) => {
                let package = self.store.bytes(*slot).and_then(|bytes| Package::decode(bytes).ok());
                package.map(|package| package.outer_weights)
            }
            None => Some(&[0.0; N][..]),
        };
        let Some(weights) = weights else { return false };
        if agent.announced {
            return agent
                .state
                .restart(&session.params, tick.saturating_sub(1), estimate, weights)
                .is_ok();
        }
        let mut holds = Holds::<N, NEIGHBOURS>::new();
        if holds.resize(session.params.neighbours().len(), None).is_err() {
            return false;
        }
        let state = AgentState::new(&session.params, estimate, weights, holds);
        match state {
            Ok(state) => {
                agent.state = state;
                true
            }
            Err(_) => false,
        }
    }
}

/// What is left of a package once it has been verified.
#[derive(Clone, Copy, Debug)]
pub(super) struct Verified {
    agent: agent_core::AgentId,
    pub(super) version: u32,
    checksum: u32,
    step_size: f32,
}

impl Verified {
    fn of(package: &Package<'_>, bytes: &[u8]) -> Self {
        Self {
            agent: package.node.agent,
            version: package.version,
            checksum: crc32(&[bytes]),
            step_size: package.node.step_size,
        }
    }

    pub(super) fn in_slot(self, slot: store::Slot) -> InUsePackage {
        let Self { agent, version, checksum, step_size } = self;
        InUsePackage { agent, version, checksum, step_size, slot }
    }
}

/// All that a package has to pass.
#[inline(never)]
pub(super) fn verified<const N: usize>(
    bytes: &[u8],
    requirements: &Requirements<'_>,
) -> Result<Verified, Refusal> {
    let mut scratch = Scratch::NEW;
    let package = accept::<N>(bytes, requirements, &mut scratch)?;
    Ok(Verified::of(&package, bytes))
}

/// What a package that was verified before still has to pass: its bytes are the same, which the
/// store has seen.
pub(super) fn decoded(bytes: &[u8]) -> Result<Verified, Refusal> {
    let package = Package::decode(bytes).map_err(|error: PackageError| Refusal::Package(error))?;
    Ok(Verified::of(&package, bytes))
}
