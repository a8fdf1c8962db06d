//! What to do about a package that a node refuses, or would refuse.

use agent_core::package::Refusal;
use agent_core::service::{RefusalKind, RefusalReport};

/// The hint for a package that fails this check.
#[must_use]
pub fn hint(kind: RefusalKind) -> &'static str {
    use RefusalKind as Kind;
    match kind {
        Kind::Older => {
            "give it a newer version with `host-sim weights renumber`, or sign it with --replaces to \
             go back on purpose"
        }
        Kind::Unsigned | Kind::Signature => {
            "sign it with the private half of the node's key (`host-sim weights sign`)"
        }
        Kind::Agent | Kind::Dimension => {
            "give the package of this agent, from the scenario that the node is part of"
        }
        Kind::Capacity => "train a smaller network, or build the firmware with more room",
        Kind::Parameter | Kind::NeighbourOrder | Kind::EmptyBox => {
            "correct the scenario and train again"
        }
        Kind::FormatVersion | Kind::Other => "build firmware and host-sim from the same source",
        Kind::TestVector => {
            "this processor computes other bits than the one that made it: build firmware and \
             host-sim from the same source, without fast-math options"
        }
        Kind::Length | Kind::Magic | Kind::Checksum | Kind::SignatureChecksum | Kind::Slot => {
            "copy the file again, or train again"
        }
        _ => "train or import it again",
    }
}

/// The check that this refusal is about.
#[must_use]
pub fn kind(refusal: &Refusal) -> RefusalKind {
    RefusalReport::from(refusal).kind
}
