//! Checks packages as a node does, with the core's own code, for any state dimension.

use agent_core::observer::network::Scratch;
use agent_core::package::{Package, PackageError, Refusal, Requirements, accept};

use super::{PackageBytes, with_dimension};

/// Decodes the package if a node of the package's state dimension with these requirements would
/// accept it.
///
/// # Errors
/// The node's refusal.
pub fn check<'b>(
    bytes: &'b PackageBytes,
    requirements: &Requirements<'_>,
) -> Result<Package<'b>, Refusal> {
    let inputs = bytes.architecture().inputs();
    let mut scratch = Scratch::NEW;
    // The last arm is unreachable: `Architecture` bounds the number of inputs.
    let accepted = with_dimension!(
        inputs,
        accept(bytes.as_bytes(), requirements, &mut scratch),
        else Err(Refusal::Package(PackageError::Malformed))
    );
    // A node does not decode the origin.
    accepted.map(|_| bytes.package())
}
