//! The inner networks of all agents, each set of parameters once.
//!
//! Agents that start with the scenario's network have equal parameters in packages of their own. A single
//! copy of them stays in the processor's cache, whereas thousands do not.

use std::sync::Arc;

use agent_core::observer::network::InnerNetwork;

use crate::packages::PackageBytes;

/// A network whose parameters may be those of other agents, too.
pub(super) type SharedNetwork = InnerNetwork<Arc<[f32]>>;

/// The networks in use so far.
#[derive(Debug, Default)]
pub(super) struct Networks {
    networks: Vec<SharedNetwork>,
}

/// Networks that are searched for equal ones: the newest. Trained networks all differ.
const SEARCHED: usize = 8;

impl Networks {
    /// Returns the network of a package.
    pub(super) fn of(&mut self, package: &PackageBytes) -> SharedNetwork {
        let content = package.package();
        let network = &content.network;
        let newest = self.networks.len().saturating_sub(SEARCHED);
        let equals = |known: &&SharedNetwork| {
            let bits =
                |parameters: &[f32]| parameters.iter().map(|p| p.to_bits()).collect::<Vec<_>>();
            known.architecture() == network.architecture()
                && bits(known.parameters()) == bits(network.parameters())
        };
        if let Some(known) = self.networks[newest..].iter().find(equals) {
            return known.clone();
        }
        let parameters = network.parameters().into();
        let shared = InnerNetwork::new(network.architecture().clone(), parameters)
            .expect("the parameters of a network");
        self.networks.push(shared.clone());
        shared
    }
}
