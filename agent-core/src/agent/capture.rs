//! Captures samples for the offline training of the inner network: pairs of the estimate and its
//! derivative, `(x_hat, d/dt x_hat)`, the paper's input-output data.
//!
//! Memory: `8 N + 8` bytes per sample. Invariant: the ring holds the newest samples, oldest first.

use core::num::NonZeroU32;

use crate::{StateVector, Tick};

/// One input-output pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// Tick at which the sample was taken.
    pub tick: Tick,
    /// `x_hat`, shape `[N]`.
    pub estimate: StateVector<N>,
    /// `d/dt x_hat`, shape `[N]`. \[state unit/s\]
    pub derivative: StateVector<N>,
}

/// Ring buffer of the newest `CAPACITY` samples, each `stride`-th tick sampled; fits in a `static`.
#[derive(Clone, Debug, Default)]
pub struct CaptureRing<const N: usize, const CAPACITY: usize> {
    samples: heapless::Deque<Sample<N>, CAPACITY>,
}

impl<const N: usize, const CAPACITY: usize> CaptureRing<N, CAPACITY> {
    /// Creates an empty ring.
    #[must_use]
    pub const fn new() -> Self {
        Self { samples: heapless::Deque::new() }
    }

    /// Stores `sample` if its tick is a multiple of `stride`; returns whether it did.
    #[inline]
    pub fn offer(&mut self, sample: &Sample<N>, stride: NonZeroU32) -> bool {
        let due = is_due(sample.tick, stride);
        if due {
            if self.samples.is_full() {
                let _ = self.samples.pop_front();
            }
            // There is room now, unless the capacity is 0.
            let _ = self.samples.push_back(*sample);
        }
        due
    }

    /// Returns the samples, oldest first.
    pub fn samples(&self) -> impl Iterator<Item = &Sample<N>> {
        self.samples.iter()
    }

    /// Returns the number of samples.
    #[must_use]
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Returns whether the ring is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Removes all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
    }
}

/// Returns whether the sample at `tick` is kept. Strides are counted from tick 0, so that all nodes
/// keep the same ticks.
#[inline]
#[must_use]
pub fn is_due(tick: Tick, stride: NonZeroU32) -> bool {
    remainder(tick, stride) == 0
}

/// `tick % stride` without a 64-bit division, which takes 900 bytes of code on a Cortex-M.
#[inline]
fn remainder(tick: Tick, stride: NonZeroU32) -> u32 {
    let (high, low) = ((tick >> 32) as u32, tick as u32);
    let mut remainder = high % stride;
    if remainder == 0 {
        return low % stride;
    }
    // Long division, bit by bit: only after 2^32 ticks, 49 days at 1 ms.
    for bit in (0..u32::BITS).rev() {
        let carry = remainder >> 31;
        remainder = remainder << 1 | (low >> bit & 1);
        if carry != 0 || remainder >= stride.get() {
            remainder = remainder.wrapping_sub(stride.get());
        }
    }
    remainder
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(tick: Tick) -> Sample<1> {
        Sample { tick, estimate: [tick as f32].into(), derivative: [0.0].into() }
    }

    proptest::proptest! {
        #[test]
        fn remainder_matches_division(tick: u64, shift in 0u32..64, stride in 1u32..) {
            let stride = NonZeroU32::new(stride).unwrap();
            for tick in [tick, tick >> shift] {
                assert_eq!(u64::from(remainder(tick, stride)), tick % u64::from(stride.get()));
            }
        }
    }

    #[test]
    fn keeps_the_newest_of_every_stride() {
        let mut ring = CaptureRing::<1, 3>::new();
        let stride = NonZeroU32::new(5).unwrap();
        let kept = (0..=23).filter(|&tick| ring.offer(&sample(tick), stride)).count();
        assert_eq!(kept, 5);
        assert_eq!(ring.len(), 3);
        assert!(ring.samples().map(|s| s.tick).eq([10, 15, 20]));
        ring.clear();
        assert!(ring.is_empty());
    }
}
