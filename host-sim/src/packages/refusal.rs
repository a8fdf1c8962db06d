//! What to do about a package that a node would refuse.

use std::path::Path;

use agent_core::package::Refusal;

use super::CommandError;

impl CommandError {
    /// The package at `path` is one that a node refuses.
    pub(super) fn refused(path: &Path, refusal: &Refusal) -> Self {
        Self::Refused { path: path.to_owned(), refusal: refusal.to_string(), hint: hint(refusal) }
    }
}

/// The hint for each refusal.
pub(super) fn hint(refusal: &Refusal) -> &'static str {
    match refusal {
        Refusal::Package(_) | Refusal::TestVector { .. } | Refusal::NoTestVectors => {
            "copy it again, or train again"
        }
        Refusal::Unsigned => "sign it with `host-sim weights sign`",
        Refusal::Signature => {
            "sign it with the private half of the node's key, or give the node's own public key"
        }
        Refusal::Dimension { .. } | Refusal::Agent { .. } => {
            "give the package of this agent, from the scenario that the node is part of"
        }
        Refusal::Capacity { .. } => "train a smaller network, or build the firmware with more room",
        Refusal::Parameter(_) | Refusal::NeighbourOrder { .. } | Refusal::EmptyBox { .. } => {
            "correct the scenario and train again"
        }
        Refusal::Older { .. } => {
            "give it a newer version with `host-sim weights renumber`, or sign it with --replaces"
        }
        _ => "train again",
    }
}
