//! Samples for the offline training of the inner network: pairs of the estimate and its
//! derivative, `(x_hat, d/dt x_hat)`, the paper's input-output data.
//!
//! Memory: `8 N + 8` bytes a sample. Invariant: the ring holds the newest samples, in the
//! order in which they were taken, one every `stride` steps.

use core::num::NonZeroU32;

use crate::{StateVector, Tick};

/// One input-output pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// When.
    pub tick: Tick,
    /// `x_hat`, shape `[N]`.
    pub estimate: StateVector<N>,
    /// `d/dt x_hat`, shape `[N]`. \[state unit/s\]
    pub derivative: StateVector<N>,
}

/// The newest `CAPACITY` of every `stride`-th sample, in a static buffer.
#[derive(Clone, Debug)]
pub struct CaptureRing<const N: usize, const CAPACITY: usize> {
    samples: heapless::HistoryBuf<Sample<N>, CAPACITY>,
    stride: NonZeroU32,
}

impl<const N: usize, const CAPACITY: usize> CaptureRing<N, CAPACITY> {
    /// An empty ring that keeps the samples whose tick is a multiple of `stride`.
    #[must_use]
    pub fn new(stride: NonZeroU32) -> Self {
        Self { samples: heapless::HistoryBuf::new(), stride }
    }

    /// Keeps `sample` if its turn has come; returns whether it did.
    #[inline]
    pub fn offer(&mut self, sample: &Sample<N>) -> bool {
        let due = is_due(sample.tick, self.stride);
        if due {
            self.samples.write(*sample);
        }
        due
    }

    /// The samples, oldest first.
    pub fn samples(&self) -> impl Iterator<Item = &Sample<N>> {
        self.samples.oldest_ordered()
    }

    /// How many samples there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether there is no sample.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
    }
}

/// Whether the sample of this tick is to be kept: every `stride`-th is, counted from tick 0,
/// so that all nodes keep the same ones.
#[inline]
#[must_use]
pub fn is_due(tick: Tick, stride: NonZeroU32) -> bool {
    tick.is_multiple_of(Tick::from(stride.get()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(tick: Tick) -> Sample<1> {
        Sample { tick, estimate: [tick as f32].into(), derivative: [0.0].into() }
    }

    #[test]
    fn keeps_the_newest_of_every_stride() {
        let mut ring = CaptureRing::<1, 3>::new(NonZeroU32::new(5).unwrap());
        let kept = (0..=23).filter(|&tick| ring.offer(&sample(tick))).count();
        assert_eq!(kept, 5);
        assert_eq!(ring.len(), 3);
        assert!(ring.samples().map(|s| s.tick).eq([10, 15, 20]));
        ring.clear();
        assert!(ring.is_empty());
    }
}
