//! Faults instead of attackers: bits that rot, and power cuts.

use super::Outcome;
use crate::store::{cut_every_way, flipped_bits as flip};

/// Flips every bit of two packages and of the journal, one at a time. Accepted: flips that nothing
/// tells. Harm: a node that then uses anything but the package from before, or the other recorded one
/// where that itself is damaged.
pub(super) fn flipped_bits(_tries: u64, _seed: u64) -> Outcome {
    let [tries, changed, told] = flip();
    Outcome { name: "flipped-bits", tries, accepted: tries - told, harm: changed }
}

/// Cuts the power in every action of a node, once and again, on flash with words of 1 to 32 bytes. Harm:
/// kinds of flash on which a node then has no package or the wrong one, finds something else at the
/// next boot, or no longer takes updates.
pub(super) fn power_cuts(_tries: u64, _seed: u64) -> Outcome {
    let kinds: [fn() -> u64; 6] = [
        cut_every_way::<1, 256>,
        cut_every_way::<2, 128>,
        cut_every_way::<4, 64>,
        cut_every_way::<8, 512>,
        cut_every_way::<16, 256>,
        cut_every_way::<32, 128>,
    ];
    let runs = kinds.map(|cut| std::panic::catch_unwind(cut).ok());
    let tries = runs.iter().flatten().sum();
    let harm = runs.iter().filter(|run| run.is_none()).count() as u64;
    Outcome { name: "power-cuts", tries, accepted: 0, harm }
}
