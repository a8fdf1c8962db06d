//! Errors and hints for packages that a node refuses or would refuse.

use std::path::Path;

use agent_core::package::Refusal;
use agent_core::service::{RefusalKind, RefusalReport};

use crate::error::{ErrorCode, ErrorReport};

/// Returns the hint for a package that fails this check.
#[must_use]
pub fn hint(kind: RefusalKind) -> &'static str {
    use RefusalKind as Kind;
    match kind {
        Kind::Older | Kind::Repeated => {
            "give it a newer version with `host-sim weights renumber`; to go back to this older network, give it \
             the package epoch after the node's with `weights renumber --epoch` or `weights sign --epoch`"
        }
        Kind::Epoch => {
            "give it the node's package epoch and a newer version, or the next package epoch, with `host-sim weights \
             renumber --epoch`"
        }
        Kind::Step => {
            "change time.step in the scenario, or the range of steps in the node's settings"
        }
        Kind::Unsigned | Kind::Signature | Kind::Digest => {
            "sign it with the private key that matches the node's public key (`host-sim weights sign`)"
        }
        Kind::Agent | Kind::Dimension => "use a package for this agent, from the node's scenario",
        Kind::Capacity => "train a smaller network, or build the firmware with a larger capacity",
        Kind::Parameter | Kind::NeighbourOrder | Kind::EmptyBox => {
            "correct the scenario and train again"
        }
        Kind::FormatVersion | Kind::UnknownSection | Kind::Inputs | Kind::Other => {
            "build firmware and host-sim from the same source"
        }
        Kind::TestVector => {
            "this processor computes different bits: build firmware and host-sim from the same \
             source, without fast-math options"
        }
        Kind::Length | Kind::Magic | Kind::Checksum | Kind::SignatureChecksum | Kind::Slot => {
            "copy the file again, or train again"
        }
        _ => "train or import it again",
    }
}

/// Returns the check that a refusal is about.
#[must_use]
pub fn kind(refusal: &Refusal) -> RefusalKind {
    RefusalReport::from(refusal).kind
}

/// Returns the error about the package at `path`, which a node would refuse.
#[must_use]
pub fn refused(path: &Path, refusal: &Refusal) -> ErrorReport {
    unfit(path, &refusal.to_string(), hint(kind(refusal)))
}

/// Returns the error about the package at `path`, which a node would refuse for this reason.
#[must_use]
pub fn unfit(path: &Path, refusal: &str, hint: &str) -> ErrorReport {
    let shown = path.display();
    let text = format!("{shown}: a node would refuse it: {refusal}; {hint}");
    ErrorReport::new(ErrorCode::PackageRefused, text).about(path)
}
