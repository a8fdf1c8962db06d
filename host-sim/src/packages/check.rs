//! Checks packages as a node does, with the core's own code, for any state dimension.

use std::path::Path;

use agent_core::observer::network::Scratch;
use agent_core::package::signature::PublicKey;
use agent_core::package::{Package, PackageError, Refusal, Requirements, accept};

use super::refusal::refused;
use super::{PackageBytes, with_dimension};
use crate::error::ErrorReport;
use crate::signing::{OperatorKey, fingerprint};

/// Decodes the package if a node of the package's state dimension with these requirements would
/// accept it.
///
/// # Errors
/// The node's refusal.
pub fn check<'b>(
    bytes: &'b PackageBytes,
    requirements: &Requirements<'_>,
) -> Result<Package<'b>, Refusal> {
    let mut scratch = Scratch::NEW;
    // The last arm is unreachable: `Architecture` bounds the number of inputs.
    let accepted = with_dimension!(
        bytes.package().dimension(),
        accept(bytes.as_bytes(), requirements, &mut scratch),
        else Err(Refusal::Package(PackageError::Malformed))
    );
    // A node does not decode the origin.
    accepted.map(|_| bytes.package())
}

/// Returns the requirements of a node with this key and this package in use.
#[must_use]
pub fn requirements<'k>(
    public_keys: &'k [PublicKey],
    in_use: Option<&PackageBytes>,
) -> Requirements<'k> {
    let before = in_use.map(PackageBytes::package);
    let requirements = Requirements {
        public_keys,
        agent: before.as_ref().map(|package| package.node.agent),
        ..Requirements::ANY
    };
    let highest = before.map(|package| requirements.serial_after_activation(&package));
    Requirements { highest, ..requirements }
}

/// Returns whether a package is signed with a key other than this one.
///
/// # Errors
/// If it is, and `replace` does not allow that signature to be replaced. `path` is the package's name in errors.
pub fn check_signature_before(
    path: &Path,
    bytes: &PackageBytes,
    key: &OperatorKey,
    replace: bool,
) -> Result<bool, ErrorReport> {
    let is_signed = bytes.is_signed() && !bytes.is_signed_by(key.public_key());
    if is_signed && !replace {
        return Err(ErrorReport::usage(format!(
            "{}: already signed with a key other than {}; give --replace-signature to replace it",
            path.display(),
            fingerprint(key.public_key())
        ))
        .about(path));
    }
    Ok(is_signed)
}

/// Returns the package with a signature by this key, unless nodes would refuse the package. `path` is its name in
/// errors.
///
/// # Errors
/// The node's refusal.
pub fn signed(
    path: &Path,
    bytes: &PackageBytes,
    key: &OperatorKey,
) -> Result<PackageBytes, ErrorReport> {
    check(bytes, &requirements(&[], None)).map_err(|refusal| refused(path, &refusal))?;
    Ok(bytes.signed(key))
}
