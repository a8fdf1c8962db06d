//! Faults instead of attackers: what rots in a node's flash.

use super::Outcome;
use crate::store::flipped_bits as flip;

/// Flips every bit of two packages and of the journal, one at a time. Accepted: flips that nothing
/// tells. Harm: a node that then uses anything but the package from before, or the other recorded one
/// where that itself is damaged.
pub(super) fn flipped_bits(_tries: u64, _seed: u64) -> Outcome {
    let [tries, changed, told] = flip();
    Outcome { name: "flipped-bits", tries, accepted: tries - told, harm: changed }
}
