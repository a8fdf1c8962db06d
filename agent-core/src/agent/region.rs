//! Boxes in state space. [`StateBox`] borrows its limits from a package; [`Region`] owns them and
//! outlives the package it was copied from.
//!
//! Memory: `8 N` bytes. Cost of a query: at most `2 N` comparisons. Invariants: the limits are
//! finite, and no lower limit exceeds its upper limit.

use crate::StateVector;
use crate::agent::hold::Hold;
use crate::math::numeric::{components, components_mut};
use crate::math::parameter::{ParameterError, finite, not_negative};

/// A box in state space with borrowed limits.
///
/// ```
/// use agent_core::StateBox;
///
/// let trained = StateBox { low: &[-1.0, -2.0], high: &[1.0, 2.0] };
/// assert!(trained.contains(&[1.0, 0.0]));
/// assert!(!trained.contains(&[1.0, 2.5]));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StateBox<'a> {
    /// Lower limit of each component, shape `[n]`.
    pub low: &'a [f32],
    /// Upper limit of each component, shape `[n]`.
    pub high: &'a [f32],
}

impl StateBox<'_> {
    /// Returns whether every component of `x` is within its limits.
    #[inline]
    #[must_use]
    pub fn contains(&self, x: &[f32]) -> bool {
        let limits = self.low.iter().zip(self.high);
        limits.zip(x).all(|((low, high), x)| low <= x && x <= high)
    }
}

/// All `x` with `low <= x <= high`, componentwise.
///
/// ```
/// use agent_core::{Region, StateVector};
///
/// let region = Region::new(StateVector::<1>::new(-1.0), StateVector::<1>::new(1.0))?;
/// assert!(!region.contains(&StateVector::<1>::new(2.0)));
/// // Wider by one and a half widths on each side: -4 to 4.
/// assert!(region.widened(1.5)?.contains(&StateVector::<1>::new(4.0)));
/// # Ok::<(), agent_core::math::parameter::ParameterError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region<const N: usize> {
    low: StateVector<N>,
    high: StateVector<N>,
}

impl<const N: usize> Region<N> {
    /// Creates a region from its limits.
    ///
    /// # Errors
    /// A limit that is not finite, or a lower limit above its upper limit.
    pub fn new(low: StateVector<N>, high: StateVector<N>) -> Result<Self, ParameterError> {
        finite("region.low", components(&low))?;
        finite("region.high", components(&high))?;
        for (&low, &high) in components(&low).iter().zip(components(&high)) {
            if low > high {
                return Err(ParameterError::OutOfRange {
                    parameter: "region.low",
                    value: low,
                    expected: "at most region.high",
                });
            }
        }
        Ok(Self { low, high })
    }

    /// Copies the limits of a package.
    ///
    /// # Errors
    /// Same as for [`Self::new`], or a box of a different dimension.
    pub fn copied(limits: &StateBox<'_>) -> Result<Self, ParameterError> {
        let copied = |parameter, limits: &[f32]| match <[f32; N]>::try_from(limits) {
            Ok(limits) => Ok(StateVector::from(limits)),
            Err(_) => Err(ParameterError::Length { parameter, expected: N, found: limits.len() }),
        };
        Self::new(copied("region.low", limits.low)?, copied("region.high", limits.high)?)
    }

    /// Returns the region that contains every finite point.
    #[must_use]
    pub fn unlimited() -> Self {
        Self { low: StateVector::repeat(f32::MIN), high: StateVector::repeat(f32::MAX) }
    }

    /// Returns the region widened on both sides by `margin` times its width in each component. A
    /// component of zero width has no scale and uses that of the widest one. A limit that would
    /// overflow becomes the largest finite number, which excludes nothing.
    ///
    /// # Errors
    /// A margin that is negative or not finite.
    pub fn widened(&self, margin: f32) -> Result<Self, ParameterError> {
        not_negative("region.margin", margin)?;
        let width = |low: f32, high: f32| limited(high - low);
        let mut wider = *self;
        let limits = components_mut(&mut wider.low).iter_mut().zip(components_mut(&mut wider.high));
        let widest = self.limits().fold(0.0, |widest, (&low, &high)| {
            let width = width(low, high);
            if width > widest { width } else { widest }
        });
        for (low, high) in limits {
            let width = width(*low, *high);
            let reach = margin * if width > 0.0 { width } else { widest };
            (*low, *high) = (limited(*low - reach), limited(*high + reach));
        }
        Ok(wider)
    }

    /// Returns all points whose components are at most `ceiling` in magnitude.
    #[must_use]
    pub fn cube(ceiling: f32) -> Self {
        Self { low: StateVector::repeat(-ceiling), high: StateVector::repeat(ceiling) }
    }

    /// Returns the region with `ceiling` and `-ceiling` in place of the limits that exclude nothing.
    #[must_use]
    pub fn with_ceiling(mut self, ceiling: f32) -> Self {
        for limits in [components_mut(&mut self.low), components_mut(&mut self.high)] {
            for limit in limits {
                if *limit == f32::MIN || *limit == f32::MAX {
                    *limit = limit.clamp(-ceiling, ceiling);
                }
            }
        }
        self
    }

    /// Returns whether the region is a single point.
    #[must_use]
    pub fn is_point(&self) -> bool {
        self.limits().all(|(low, high)| low == high)
    }

    /// Returns the midpoint.
    #[must_use]
    pub fn centre(&self) -> StateVector<N> {
        let mut centre = self.low;
        for (low, high) in components_mut(&mut centre).iter_mut().zip(components(&self.high)) {
            *low = *low * 0.5 + high * 0.5;
        }
        centre
    }

    /// Returns the lower and the upper limit of each component.
    #[inline]
    fn limits(&self) -> impl Iterator<Item = (&f32, &f32)> {
        components(&self.low).iter().zip(components(&self.high))
    }

    /// Clears the slots whose sample is outside; returns how many.
    pub(crate) fn discard_outside(&self, places: &mut [Option<Hold<N>>]) -> usize {
        let mut discarded = 0;
        for place in places {
            if Hold::present(place).is_some_and(|held| !self.contains(held.estimate())) {
                *place = None;
                discarded += 1;
            }
        }
        discarded
    }

    /// Returns whether every component of `x` is within its limits; false for NaN.
    #[inline]
    #[must_use]
    pub fn contains(&self, x: &StateVector<N>) -> bool {
        self.limits().zip(components(x)).all(|((low, high), x)| low <= x && x <= high)
    }
}

/// Replaces an infinite limit with the largest finite number of its sign.
#[inline(never)]
fn limited(limit: f32) -> f32 {
    limit.clamp(f32::MIN, f32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_belong_to_the_region_and_nothing_beyond_them() {
        let region =
            Region::<2>::copied(&StateBox { low: &[-1.0, 2.0], high: &[3.0, 2.0] }).unwrap();
        assert_eq!(region.centre(), StateVector::<2>::new(1.0, 2.0));
        for (x, inside) in [
            ([-1.0, 2.0], true),
            ([3.0, 2.0], true),
            ([3.5, 2.0], false),
            ([0.0, 1.5], false),
            ([f32::NAN, 2.0], false),
            ([0.0, f32::INFINITY], false),
        ] {
            assert_eq!(region.contains(&x.into()), inside, "{x:?}");
        }
    }

    #[test]
    fn widening_scales_with_each_components_width() {
        let region = Region::<3>::new([-1.0, 2.0, 0.0].into(), [3.0, 2.0, 1.0].into()).unwrap();
        let expected = Region::new([-9.0, -6.0, -2.0].into(), [11.0, 10.0, 3.0].into());
        assert_eq!(region.widened(2.0), expected);
        assert_eq!(region.widened(0.0), Ok(region));
    }

    #[test]
    fn limits_saturate_at_the_largest_number() {
        let unlimited = Region::<2>::unlimited();
        for margin in [0.0, 1e-30, 10.0, f32::MAX] {
            assert_eq!(unlimited.widened(margin), Ok(unlimited));
        }
        let region = Region::<2>::new([-1e38, 2.0].into(), [1e38, 2.0].into()).unwrap();
        assert_eq!(region.widened(10.0), Ok(unlimited));
        let low_only = Region::<2>::new([f32::MIN, 0.0].into(), [0.0, 1.0].into()).unwrap();
        let expected = Region::new([f32::MIN, -2.0].into(), [f32::MAX, 3.0].into());
        assert_eq!(low_only.widened(2.0), expected);
        assert_eq!(unlimited.centre(), StateVector::<2>::zeros());
        assert!(unlimited.contains(&[f32::MIN, f32::MAX].into()));
        assert!(!unlimited.contains(&[f32::INFINITY, 0.0].into()));
        assert!(!unlimited.contains(&[0.0, f32::NAN].into()));
        assert!(!region.is_point());
        assert!(Region::<1>::new([2.0].into(), [2.0].into()).unwrap().is_point());
    }

    #[test]
    fn refuses_invalid_limits() {
        let region = |low: f32, high: f32| Region::<1>::new([low].into(), [high].into());
        assert!(region(1.0, 0.5).is_err());
        assert!(region(f32::NAN, 1.0).is_err());
        assert!(region(0.0, f32::INFINITY).is_err());
        for margin in [-1.0, f32::NAN, f32::INFINITY] {
            assert!(region(-1.0, 1.0).unwrap().widened(margin).is_err());
        }
        assert!(Region::<2>::copied(&StateBox { low: &[0.0; 2], high: &[1.0; 3] }).is_err());
    }
}
