//! Locations of a network and `Gamma` within a package, for a node that cannot keep references.
//!
//! A node writes one slot of its flash while it runs from the other, and no safe reference into
//! flash can outlive a write to it. The node therefore stores the location and builds the network
//! from it in every step, which costs some 30 operations and checks only that the bytes are long
//! enough.

use core::ops::Range;

use super::wire::WORD;
use super::{AgentConfig, Package};
use crate::agent::AgentParams;
use crate::math::parameter::ParameterError;
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::Neighbour;
use crate::observer::network::{Architecture, InnerNetwork};

/// Location of a decoded package's inner network in the package's bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkPlace {
    architecture: Architecture,
    /// Offset of the inner parameters from the first byte of the package.
    start: usize,
    end: usize,
    /// Range of the outer weights.
    outer_weights: Range<usize>,
}

impl NetworkPlace {
    /// Locates the network of `package` in `bytes`; `None` if it was not decoded from them.
    #[must_use]
    pub fn new(package: &Package<'_>, bytes: &[u8]) -> Option<Self> {
        let Range { start, end } = range_in(bytes, package.network.parameters())?;
        let outer_weights = range_in(bytes, package.outer_weights)?;
        let architecture = package.network.architecture().clone();
        Some(Self { architecture, start, end, outer_weights })
    }

    /// Returns the network in the same bytes.
    #[inline]
    #[must_use]
    pub fn network<'a>(&self, bytes: &'a [u8]) -> Option<InnerNetwork<&'a [f32]>> {
        // The length is that of the parameters that were checked with this architecture.
        let parameters = self.parameters(bytes)?;
        Some(InnerNetwork::verified(self.architecture.clone(), parameters))
    }

    /// Returns the network's parameters in the same bytes.
    #[inline]
    #[must_use]
    pub fn parameters<'a>(&self, bytes: &'a [u8]) -> Option<&'a [f32]> {
        bytemuck::try_cast_slice(bytes.get(self.start..self.end)?).ok()
    }

    /// Returns the package's outer weights in the same bytes, row by row, shape `[L, n]`.
    #[must_use]
    pub fn outer_weights<'a>(&self, bytes: &'a [u8]) -> Option<&'a [f32]> {
        bytemuck::try_cast_slice(bytes.get(self.outer_weights.clone())?).ok()
    }

    /// Returns the widths and activations.
    #[must_use]
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }
}

/// An agent's parameters without references into its package. Up to `NEIGHBOURS` neighbours are
/// copied; `Gamma`, which can have `L^2` entries, is located in the package's bytes.
/// [`AgentParams`] are built from it in every step, by copying and without checks.
#[derive(Clone, Debug)]
pub struct ParamsPlace<const N: usize, const NEIGHBOURS: usize> {
    /// Without neighbours.
    params: AgentParams<'static, N>,
    neighbours: heapless::Vec<Neighbour, NEIGHBOURS>,
    outer_gain: GainPlace,
}

#[derive(Clone, Debug)]
enum GainPlace {
    /// Not stored in a package.
    Elsewhere(SymmetricMatrix<'static>),
    /// At this byte range of the package.
    Diagonal(Range<usize>),
    /// At this byte range of the package.
    Full(Range<usize>),
}

impl<const N: usize, const NEIGHBOURS: usize> ParamsPlace<N, NEIGHBOURS> {
    /// Locates the parameters of `package`, which was decoded from `bytes`.
    ///
    /// # Errors
    /// Any error of [`AgentConfig::params`], too many neighbours, or a package that was decoded
    /// from other bytes.
    pub fn new(package: &Package<'_>, bytes: &[u8]) -> Result<Self, ParameterError> {
        let place = |entries: &[f32]| {
            let range = range_in(bytes, entries);
            range.ok_or(ParameterError::Length {
                parameter: "bytes of the package",
                expected: WORD * entries.len(),
                found: bytes.len(),
            })
        };
        let outer_gain = match package.node.outer_law.gain {
            SymmetricMatrix::Scalar(entry) => GainPlace::Elsewhere(SymmetricMatrix::Scalar(entry)),
            SymmetricMatrix::Diagonal(entries) => GainPlace::Diagonal(place(entries)?),
            SymmetricMatrix::Full(entries) => GainPlace::Full(place(entries)?),
        };
        Self::with_gain(&package.node, outer_gain)
    }

    /// Creates the parameters of an agent that is built into the firmware.
    ///
    /// # Errors
    /// Same as for [`Self::new`].
    pub fn built_in(config: &AgentConfig<'static>) -> Result<Self, ParameterError> {
        Self::with_gain(config, GainPlace::Elsewhere(config.outer_law.gain))
    }

    fn with_gain(config: &AgentConfig<'_>, outer_gain: GainPlace) -> Result<Self, ParameterError> {
        let mut neighbours = heapless::Vec::new();
        for neighbour in config.neighbours() {
            neighbours.push(neighbour).map_err(|_| ParameterError::Length {
                parameter: "observer.neighbours",
                expected: NEIGHBOURS,
                found: config.neighbours.len(),
            })?;
        }
        let params = config
            .joined::<N>(&neighbours, config.outer_law.gain)?
            .relocated(&[], SymmetricMatrix::Diagonal(&[]));
        Ok(Self { params, neighbours, outer_gain })
    }

    /// Returns the parameters; `bytes` are those of the package, or empty for a built-in agent.
    /// `None` if they do not contain `Gamma`.
    #[inline(always)] // A call would copy the parameters twice.
    #[must_use]
    pub fn params<'a>(&'a self, bytes: &'a [u8]) -> Option<AgentParams<'a, N>> {
        let words = |range: &Range<usize>| bytemuck::try_cast_slice(bytes.get(range.clone())?).ok();
        let outer_gain = match &self.outer_gain {
            GainPlace::Elsewhere(gain) => *gain,
            GainPlace::Diagonal(range) => SymmetricMatrix::Diagonal(words(range)?),
            GainPlace::Full(range) => SymmetricMatrix::Full(words(range)?),
        };
        Some(self.params.relocated(&self.neighbours, outer_gain))
    }

    /// Returns the neighbours, in the order of an inbox's slots.
    #[must_use]
    pub fn neighbours(&self) -> &[Neighbour] {
        &self.neighbours
    }

    /// Returns `dt`. \[s\]
    #[must_use]
    pub fn step_size(&self) -> f32 {
        self.params.step_size()
    }
}

/// Returns the range of `numbers` within `bytes`; `None` if they are not part of them.
fn range_in(bytes: &[u8], numbers: &[f32]) -> Option<Range<usize>> {
    let start = numbers.as_ptr().addr().checked_sub(bytes.as_ptr().addr())?;
    let end = start + WORD * numbers.len();
    (bytes.len() >= end).then_some(start..end)
}
