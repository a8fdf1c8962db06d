//! The words that a frame carries after its header.

use crate::{INPUTS_MAX, NODE_DIMENSION_MAX};

/// Largest number of words of a node's frame: those of the longest estimate or field announcement. With
/// them, authentic frames still fit into packets of IEEE 802.15.4 with their header.
pub const WORDS_MAX: usize = if cfg!(feature = "field") { 17 } else { NODE_DIMENSION_MAX };

/// Room for words: with the feature `wide` also for estimates that no node has.
pub(super) const WORDS_CAPACITY: usize = most_words(INPUTS_MAX);

/// Returns the largest number of words of a frame of agents with this state dimension.
pub(super) const fn most_words(dimension: usize) -> usize {
    if dimension > WORDS_MAX { dimension } else { WORDS_MAX }
}

/// The words of a frame's content.
pub type Words = heapless::Vec<[u8; 4], WORDS_CAPACITY>;
