//! A node: everything from the measurement to the broadcast bytes.

use core::num::NonZeroU32;

use agent_core::StateVector;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState};
use agent_core::health::{
    FallBack, Health, HealthParams, HealthSettings, WatchedAgent, WatchedStep,
};
use agent_core::observer::feedback::Neighbour;
use agent_core::observer::network::Scratch;
use agent_core::package::{AgentConfig, NetworkPlace};
use agent_core::wire::frame::{FrameBytes, FrameError};

use crate::Unusable;
use crate::package;

/// State dimension, features and neighbours of the paper's agent 1.
pub(crate) const N: usize = 3;
pub(crate) const FEATURES: usize = 5;
pub(crate) const NEIGHBOURS: usize = 2;

const SETTINGS: HealthSettings = HealthSettings {
    fall_back: Some(FallBack {
        after: NonZeroU32::new(3).unwrap(),
        return_after: NonZeroU32::new(20).unwrap(),
        outside_box: true,
        projection_active: true,
        diverged: true,
    }),
    plausible_margin: 10.0,
    restart_after: NonZeroU32::new(5),
    telemetry_interval: 100,
};

/// Buffers for the parameters that a package's bytes only describe.
#[derive(Debug)]
pub(crate) struct ParamBuffers {
    neighbours: [Neighbour; NEIGHBOURS],
    gain: [f32; 1],
}

impl ParamBuffers {
    pub(crate) const EMPTY: Self =
        Self { neighbours: [Neighbour { id: 0, weight: 0.0 }; NEIGHBOURS], gain: [0.0] };

    /// Returns the parameters of a package's agent.
    pub(crate) fn params(
        &mut self,
        config: &AgentConfig<'_>,
    ) -> Result<AgentParams<'_, N>, Unusable> {
        config
            .params::<N>(&mut self.neighbours, &mut self.gain)
            .map_err(|_| Unusable { what: "the package's parameters are invalid" })
    }
}

/// A node that uses the embedded package.
#[derive(Debug)]
pub(crate) struct Node<'a> {
    pub(crate) params: AgentParams<'a, N>,
    pub(crate) state: AgentState<N, FEATURES, [Option<Hold<N>>; NEIGHBOURS]>,
    pub(crate) inbox: Inbox<N, [Option<Hold<N>>; NEIGHBOURS]>,
    pub(crate) health: Health,
    health_params: HealthParams<N>,
    network: NetworkPlace,
    outer_weights: &'static [f32],
}

impl<'a> Node<'a> {
    pub(crate) fn new(
        places: &'a mut ParamBuffers,
        scratch: &mut Scratch,
    ) -> Result<Self, Unusable> {
        let package = package::package(scratch)?;
        let params = places.params(&package.node)?;
        let state = AgentState::new(
            &params,
            StateVector::zeros(),
            package.outer_weights,
            [None; NEIGHBOURS],
        )
        .map_err(|_| Unusable { what: "the package's agent is invalid" })?;
        let health_params = HealthParams::new(
            &params,
            &package.trained_box,
            package.broadcast_interval_min,
            &SETTINGS,
        )
        .map_err(|_| Unusable { what: "the package's box is invalid" })?;
        let network = NetworkPlace::new(&package, package::bytes())
            .ok_or(Unusable { what: "the package cannot be located" })?;
        Ok(Self {
            params,
            state,
            inbox: Inbox::new([None; NEIGHBOURS]),
            health: Health::new(),
            health_params,
            network,
            outer_weights: package.outer_weights,
        })
    }

    /// Replaces the outer weights with the package's multiplied by `factor`.
    pub(crate) fn enlarge_outer_weights(&mut self, factor: f32) -> Result<(), Unusable> {
        let mut entries = [0.0; FEATURES * N];
        for (entry, original) in entries.iter_mut().zip(self.outer_weights) {
            *entry = factor * original;
        }
        self.state
            .replace_outer_weights(&self.params, &entries)
            .map_err(|_| Unusable { what: "the enlarged outer weights are invalid" })
    }

    fn watched(&mut self) -> Watched<'_> {
        let Self { params, state, inbox, health, health_params, .. } = self;
        WatchedAgent { params, health_params, state, inbox, health }
    }

    /// Receives a frame. Not inlined, so that its instructions are those on a node.
    #[inline(never)]
    pub(crate) fn receive(&mut self, bytes: &[u8]) -> Result<(), FrameError> {
        self.watched().receive(bytes)
    }

    /// Takes a step and writes the broadcast, if any, to `broadcast`. Not inlined, so that its
    /// instructions are those on a node.
    #[inline(never)]
    pub(crate) fn step(
        &mut self,
        package: &[u8],
        tick: u64,
        measurement: &[f32],
        broadcast: &mut FrameBytes,
    ) -> WatchedStep<N> {
        broadcast.clear();
        let network = self.network.network(package);
        let outer_weights = self.outer_weights;
        let step = self.watched().step(network.as_ref(), outer_weights, tick, measurement);
        if let Some(frame) = step.broadcast() {
            *broadcast = frame.encode();
        }
        step
    }
}

type Watched<'a> =
    WatchedAgent<'a, N, FEATURES, [Option<Hold<N>>; NEIGHBOURS], [Option<Hold<N>>; NEIGHBOURS]>;
