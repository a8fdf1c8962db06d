//! What a node would say to a package: the core's own acceptance, for any state dimension.

use agent_core::observer::network::Scratch;
use agent_core::package::{Package, PackageError, Refusal, Requirements, accept};

use super::{PackageBytes, with_dimension};

/// The package in `bytes`, if a node of the package's own state dimension with these
/// requirements would accept it.
///
/// # Errors
/// What the node says.
pub fn check<'b>(
    bytes: &'b PackageBytes,
    requirements: &Requirements<'_>,
) -> Result<Package<'b>, Refusal> {
    let inputs = bytes.architecture().inputs();
    let mut scratch = Scratch::NEW;
    // No network has another number of inputs, so the last arm is never reached.
    with_dimension!(
        inputs,
        accept(bytes.as_bytes(), requirements, &mut scratch),
        else Err(Refusal::Package(PackageError::Malformed))
    )
}
