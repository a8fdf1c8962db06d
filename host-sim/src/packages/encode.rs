//! Encoding a package into a buffer of its size.

use agent_core::package::{EncodeError, Format, Package};

/// Returns the bytes of the unsigned package in this format.
pub(super) fn encode(format: Format, package: &Package<'_>) -> Result<Vec<u8>, EncodeError> {
    // An upper bound; truncated below.
    let numbers = package.network.parameters().len()
        + package.outer_weights.len()
        + package.test_vectors.len();
    let dimension = package.dimension();
    let node = 3 * dimension * dimension
        + 2 * package.node.edge_weights.len()
        + package.node.outer_law.gain.entries().len();
    let mut buffer = vec![0; 4 * (numbers + node) + package.provenance.recipe.len() + 1024];
    let length = package.encode(format, &mut buffer)?;
    buffer.truncate(length);
    Ok(buffer)
}
