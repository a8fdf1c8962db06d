//! Where a network lies, for those who cannot hold on to a reference.
//!
//! A node writes one slot of its flash while it works from the other, and no safe reference into
//! a flash can outlive a write to it. So a node keeps the place, and turns it into a network
//! anew for every step, which costs some 30 operations and checks nothing but that the bytes reach
//! that far.

use super::Package;
use super::decode::WORD;
use crate::observer::network::{Architecture, InnerNetwork};

/// The inner network of a package that has been decoded, as a place in its bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkPlace {
    architecture: Architecture,
    /// Where the inner parameters begin, from the first byte of the package.
    start: usize,
    end: usize,
}

impl NetworkPlace {
    /// The place of `package`'s network in `bytes`, from which it was decoded; `None` if it was
    /// not.
    #[must_use]
    pub fn new(package: &Package<'_>, bytes: &[u8]) -> Option<Self> {
        let parameters = package.network.parameters();
        let start = parameters.as_ptr().addr().checked_sub(bytes.as_ptr().addr())?;
        let place = Self {
            architecture: package.network.architecture().clone(),
            start,
            end: start + WORD * parameters.len(),
        };
        (bytes.len() >= place.end).then_some(place)
    }

    /// The network, in the same bytes.
    #[inline]
    #[must_use]
    pub fn network<'a>(&self, bytes: &'a [u8]) -> Option<InnerNetwork<&'a [f32]>> {
        // A place has the length of the parameters that were joined to its architecture.
        let parameters = self.parameters(bytes)?;
        Some(InnerNetwork::verified(self.architecture.clone(), parameters))
    }

    /// The network's parameters, in the same bytes.
    #[inline]
    #[must_use]
    pub fn parameters<'a>(&self, bytes: &'a [u8]) -> Option<&'a [f32]> {
        bytemuck::try_cast_slice(bytes.get(self.start..self.end)?).ok()
    }

    /// The package's outer weights, row by row, shape `[L, n]`, in the same bytes: they follow the
    /// network's parameters.
    #[must_use]
    pub fn outer_weights<'a>(&self, bytes: &'a [u8]) -> Option<&'a [f32]> {
        let length = WORD * self.architecture.features() * self.architecture.inputs();
        bytemuck::try_cast_slice(bytes.get(self.end..)?.get(..length)?).ok()
    }

    /// Widths and activations.
    #[must_use]
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }
}
