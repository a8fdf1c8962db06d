//! The words that a frame carries after its header.

use crate::INPUTS_MAX;

/// Largest number of words: those of the longest estimate or field announcement. With them, authentic
/// frames still fit into packets of IEEE 802.15.4 with their header.
pub const WORDS_MAX: usize = if cfg!(feature = "field") { 17 } else { INPUTS_MAX };

/// The words of a frame's content.
pub type Words = heapless::Vec<[u8; 4], WORDS_MAX>;
