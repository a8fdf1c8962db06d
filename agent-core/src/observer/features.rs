//! What the outer weights combine: `sigma(Phi_hat(x_hat))` of `Observer i`.
//!
//! On a node that is the [`InnerNetwork`]. A step takes whatever implements [`Features`], so a simulator can hand over
//! features that it has computed for many agents at once, append known inputs to the state, or compare
//! the network with another basis. The choice is made at compile time and costs a node nothing.

use super::network::{InnerNetwork, Scratch};

/// Functions of the estimate that the outer weights combine.
pub trait Features {
    /// Returns the dimension of the estimate that [`Self::features`] takes.
    fn inputs(&self) -> usize;

    /// Returns `L`, the number of features.
    fn count(&self) -> usize;

    /// Whether the outer weights adapt online.
    #[inline]
    fn adapts(&self) -> bool {
        true
    }

    /// Returns the features at the estimate `x`, shape `[L]`, which may be stored in `scratch`; `None` if
    /// `x` does not have the dimension [`Self::inputs`].
    fn features<'s>(&'s self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]>;
}

impl<P: AsRef<[f32]>> Features for InnerNetwork<P> {
    #[inline]
    fn inputs(&self) -> usize {
        self.architecture().inputs()
    }

    #[inline]
    fn count(&self) -> usize {
        self.architecture().features()
    }

    #[inline]
    fn features<'s>(&'s self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]> {
        Self::features(self, x, scratch)
    }
}
