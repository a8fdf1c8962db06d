//! What a broadcast of the field observer says besides the estimate: how the sample evolves, and the
//! disturbances of the directions in which neighbours follow the sender.
//!
//! In a frame of kind 1 these words follow each other: a head, the estimate, the rates (with a rate
//! hold), and for each announced direction `b`, or `b`, `p` and `q`. The head holds from its lowest bit:
//! 16 bits of digest, 12 of directions, 2 of the kind of hold, 1 for harmonics, 1 for numbers in half
//! precision, of which two share a word.
//!
//! States of more than 12 components have no announcements.
//!
//! Invariant: any words decode to an announcement of finite numbers or to nothing.

use crate::math::half::{from_half, to_half};
use crate::math::numeric::{all_finite, components, components_mut, zeros};
use crate::wire::words::{WORDS_MAX, Words};
use crate::{NODE_DIMENSION_MAX, StateVector};

/// State of the model of one direction. \[unit of `xi`/s\]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Disturbance {
    /// `b`.
    pub bias: f32,
    /// `p`.
    pub cosine: f32,
    /// `q`.
    pub sine: f32,
}

impl Disturbance {
    /// No disturbance.
    pub const NONE: Self = Self { bias: 0.0, cosine: 0.0, sine: 0.0 };

    /// Whether all numbers are finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.bias.is_finite() && self.cosine.is_finite() && self.sine.is_finite()
    }
}

/// How a sample evolves until the next one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum HoldKind {
    /// It is held constant, as in the paper.
    #[default]
    ZeroOrder,
    /// It moves at the rate that the frame carries.
    Rate,
    /// It moves as the network and the announced disturbances say.
    Model,
}

impl HoldKind {
    /// All kinds, by their numbers in frames and packages.
    pub const ALL: [Self; 3] = [Self::ZeroOrder, Self::Rate, Self::Model];
}

/// The part of a field frame besides the estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Announced<const N: usize> {
    /// Digest of what the sender predicts with; 0 without a network.
    pub digest: u16,
    /// How the sample evolves.
    pub hold: HoldKind,
    /// Whether disturbances have a harmonic part.
    pub has_harmonics: bool,
    /// Whether numbers are sent in half precision.
    pub is_half: bool,
    /// Bit `c` is set if direction `c` is announced.
    pub directions: u16,
    /// The rate of the sample, shape `[N]`; 0 unless the hold is a rate hold. \[state unit/s\]
    pub rate: StateVector<N>,
    /// The disturbances; 0 where not announced.
    pub disturbances: [Disturbance; N],
}

const DIRECTIONS_AT: u32 = 16;
const HOLD_AT: u32 = DIRECTIONS_AT + NODE_DIMENSION_MAX as u32;
const HARMONICS_AT: u32 = HOLD_AT + 2;
const HALF_AT: u32 = HARMONICS_AT + 1;

/// Numbers of a frame, one or two in a word.
struct Numbers {
    words: Words,
    is_half: bool,
    /// Whether the last word has room for another half.
    is_open: bool,
    fits: bool,
}

impl Numbers {
    fn word(&mut self, word: [u8; 4]) {
        self.fits &= self.words.push(word).is_ok();
    }

    fn push(&mut self, number: f32) {
        if !self.is_half {
            return self.word(number.to_le_bytes());
        }
        let [low, high] = to_half(number).to_le_bytes();
        self.is_open = !self.is_open;
        if self.is_open {
            self.word([low, high, 0, 0]);
        } else if let Some(word) = self.words.last_mut() {
            [word[2], word[3]] = [low, high];
        }
    }
}

impl<const N: usize> Announced<N> {
    /// Nothing: all zero.
    pub const NONE: Self = Self {
        digest: 0,
        hold: HoldKind::ZeroOrder,
        has_harmonics: false,
        is_half: false,
        directions: 0,
        rate: zeros(),
        disturbances: [Disturbance::NONE; N],
    };

    /// Returns the number of words that this many rates and announced directions take.
    pub(crate) const fn words_for(
        rates: usize,
        directions: usize,
        has_harmonics: bool,
        is_half: bool,
    ) -> usize {
        let numbers = N + rates + directions * if has_harmonics { 3 } else { 1 };
        1 + if is_half { numbers.div_ceil(2) } else { numbers }
    }

    /// Whether direction `c` is announced.
    #[inline]
    #[must_use]
    pub fn announces(&self, c: usize) -> bool {
        self.directions >> c & 1 == 1
    }

    /// Returns the disturbance of direction `c`, if announced.
    #[inline]
    #[must_use]
    pub fn disturbance(&self, c: usize) -> Option<&Disturbance> {
        self.disturbances.get(c).filter(|_| self.announces(c))
    }

    /// Returns the words of a frame with this estimate; none if they do not fit.
    #[must_use]
    pub fn words(&self, estimate: &StateVector<N>) -> Words {
        let head = u32::from(self.digest)
            | u32::from(self.directions) << DIRECTIONS_AT
            | (self.hold as u32) << HOLD_AT
            | u32::from(self.has_harmonics) << HARMONICS_AT
            | u32::from(self.is_half) << HALF_AT;
        let mut numbers =
            Numbers { words: Words::new(), is_half: self.is_half, is_open: false, fits: true };
        numbers.word(head.to_le_bytes());
        components(estimate).iter().for_each(|&x| numbers.push(x));
        if self.hold == HoldKind::Rate {
            components(&self.rate).iter().for_each(|&rate| numbers.push(rate));
        }
        for c in 0..N {
            let Some(disturbance) = self.disturbance(c) else { continue };
            numbers.push(disturbance.bias);
            if self.has_harmonics {
                numbers.push(disturbance.cosine);
                numbers.push(disturbance.sine);
            }
        }
        if numbers.fits { numbers.words } else { Words::new() }
    }

    /// Rounds estimate and announcement to what a frame carries.
    pub(crate) fn round(&mut self, estimate: &mut StateVector<N>) {
        if !self.is_half {
            return;
        }
        let round = |x: &mut f32| *x = from_half(to_half(*x));
        components_mut(estimate).iter_mut().for_each(round);
        components_mut(&mut self.rate).iter_mut().for_each(round);
        for Disturbance { bias, cosine, sine } in &mut self.disturbances {
            [bias, cosine, sine].into_iter().for_each(round);
        }
    }

    /// Returns the announcement with all digits, if they fit into a frame.
    pub(crate) fn unrounded(&self) -> Self {
        let rates = if self.hold == HoldKind::Rate { N } else { 0 };
        let directions = self.directions.count_ones() as usize;
        let words = Self::words_for(rates, directions, self.has_harmonics, false);
        Self { is_half: self.is_half && words > WORDS_MAX, ..*self }
    }

    /// Decodes the words of a frame into estimate and announcement; `None` if they are anything else, or if a number
    /// is not finite.
    #[must_use]
    pub fn from_words(words: &[[u8; 4]]) -> Option<(StateVector<N>, Self)> {
        if N > NODE_DIMENSION_MAX {
            return None;
        }
        let (head, rest) = words.split_first()?;
        let head = u32::from_le_bytes(*head);
        let directions = (head >> DIRECTIONS_AT) as u16 & 0xfff;
        let hold = *HoldKind::ALL.get((head >> HOLD_AT & 3) as usize)?;
        let has_harmonics = head >> HARMONICS_AT & 1 == 1;
        let is_half = head >> HALF_AT & 1 == 1;
        let rates = if hold == HoldKind::Rate { N } else { 0 };
        let count = directions.count_ones() as usize;
        if u32::from(directions) >> N != 0
            || words.len() != Self::words_for(rates, count, has_harmonics, is_half)
        {
            return None;
        }
        let mut place = 0;
        let mut next = || {
            let number = if is_half {
                let [a, b, c, d] = *rest.get(place / 2)?;
                let half = if place % 2 == 0 { [a, b] } else { [c, d] };
                from_half(u16::from_le_bytes(half))
            } else {
                f32::from_le_bytes(*rest.get(place)?)
            };
            place += 1;
            Some(number)
        };
        let mut estimate = zeros();
        components_mut(&mut estimate).iter_mut().try_for_each(|x| next().map(|n| *x = n))?;
        let mut rate = zeros();
        if hold == HoldKind::Rate {
            components_mut(&mut rate).iter_mut().try_for_each(|x| next().map(|n| *x = n))?;
        }
        let mut disturbances = [Disturbance::NONE; N];
        for (c, disturbance) in disturbances.iter_mut().enumerate() {
            if directions >> c & 1 == 0 {
                continue;
            }
            disturbance.bias = next()?;
            if has_harmonics {
                (disturbance.cosine, disturbance.sine) = (next()?, next()?);
            }
        }
        // An unused half is 0, so that every announcement has one byte string.
        let numbers = N + rates + count * if has_harmonics { 3 } else { 1 };
        if is_half && numbers % 2 == 1 && next()?.to_bits() != 0 {
            return None;
        }
        let digest = head as u16;
        let is_finite = all_finite(&estimate)
            && all_finite(&rate)
            && disturbances.iter().all(Disturbance::is_finite);
        let announced =
            Self { digest, hold, has_harmonics, is_half, directions, rate, disturbances };
        is_finite.then_some((estimate, announced))
    }
}
