//! Hands features that were computed ahead to a step.

use agent_core::observer::features::Features;
use agent_core::observer::network::Scratch;

/// The features at one input.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine) struct Computed<'a, const N: usize> {
    pub(super) input: &'a [f32; N],
    pub(super) features: &'a [f32],
}

/// A source of features that have been computed ahead for one input.
///
/// It hands them over if a step asks for exactly this input, bit by bit, and has every other computed by
/// `source`, as with the field observer, which asks for features at the samples of neighbours, too. So a
/// step has the results of `source`, whatever was computed.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine) struct Ahead<'a, F, const N: usize> {
    pub(in crate::engine) source: &'a F,
    /// Computed by the same source.
    pub(in crate::engine) computed: Option<Computed<'a, N>>,
}

impl<F: Features, const N: usize> Features for Ahead<'_, F, N> {
    #[inline]
    fn inputs(&self) -> usize {
        self.source.inputs()
    }

    #[inline]
    fn count(&self) -> usize {
        self.source.count()
    }

    #[inline]
    fn adapts(&self) -> bool {
        self.source.adapts()
    }

    #[inline]
    fn features<'s>(&'s self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]> {
        if let Some(Computed { input, features }) = self.computed
            && let Ok(x) = <&[f32; N]>::try_from(x)
            && x.map(f32::to_bits) == input.map(f32::to_bits)
        {
            return Some(features);
        }
        self.source.features(x, scratch)
    }
}
