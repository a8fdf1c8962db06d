//! The inner networks of all agents, each set of parameters once.
//!
//! Agents that start with the scenario's network have equal parameters in packages of their own. A single
//! copy of them stays in the processor's cache, whereas thousands do not.

use agent_core::observer::network::InnerNetwork;

use crate::basis::SharedNetwork;
use crate::packages::PackageBytes;

/// The newest networks in use.
#[derive(Debug, Default)]
pub(super) struct Networks {
    newest: Vec<SharedNetwork>,
}

/// Networks that are kept to be found again: the newest. Trained networks all differ.
const SEARCHED: usize = 8;

impl Networks {
    /// Returns the network of a package.
    pub(super) fn of(&mut self, package: &PackageBytes) -> SharedNetwork {
        let content = package.package();
        let network = &content.network;
        let equals = |known: &&SharedNetwork| {
            let bits = |parameter: &f32| parameter.to_bits();
            let parameters = network.parameters().iter().map(bits);
            known.architecture() == network.architecture()
                && parameters.eq(known.parameters().iter().map(bits))
        };
        if let Some(known) = self.newest.iter().find(equals) {
            return known.clone();
        }
        let parameters = network.parameters().into();
        let shared = InnerNetwork::new(network.architecture().clone(), parameters)
            .expect("the parameters of a network");
        if self.newest.len() == SEARCHED {
            self.newest.remove(0);
        }
        self.newest.push(shared.clone());
        shared
    }
}
