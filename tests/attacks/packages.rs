//! Attacks with packages: old ones that were signed by the operator once, and new ones that look
//! valid and do harm.

use std::collections::BTreeSet;

use agent_core::package::{Requirements, Serial};
use host_sim::signing::OperatorKey;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Outcome;
use crate::trial::harmful_packages;

/// Longest history of a node. \[packages offered\]
const OFFERS: u32 = 40;

/// Offers packages that a node has activated before, in its random history of updates, confirmed or
/// reverted, steps back by epochs and permissions of format 1. Accepted: those that it takes again.
pub(super) fn replayed(tries: u64, seed: u64) -> Outcome {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let operator = OperatorKey::generate().unwrap();
    let key = operator.public_key();
    let (mut tried, mut accepted) = (0, 0);
    while tried < tries {
        let mut highest = None;
        let mut activated = BTreeSet::new();
        for _ in 0..rng.random_range(2..=OFFERS) {
            let is_replay = !activated.is_empty() && rng.random_bool(0.5);
            let (serial, replaces) = if is_replay {
                tried += 1;
                *activated.iter().nth(rng.random_range(0..activated.len())).unwrap()
            } else {
                let version = match rng.random_range(0..20) {
                    0 => u32::MAX - rng.random_range(0..3),
                    _ => rng.random_range(0..12),
                };
                let serial = Serial { epoch: rng.random_range(0..3), version };
                let replaces = [None, Some(rng.random_range(0..12)), Some(u32::MAX)];
                (serial, replaces[rng.random_range(0..3)])
            };
            let node = Requirements {
                public_keys: std::slice::from_ref(key),
                highest,
                ..Requirements::ANY
            };
            if node.check_serial(serial, replaces).is_ok() {
                accepted += u64::from(is_replay);
                activated.insert((serial, replaces));
                highest = Some(node.serial_after(serial, replaces));
            }
        }
    }
    Outcome { name: "replayed-packages", tries: tried, accepted, harm: accepted }
}

/// Pushes packages with one harmful change each to nodes that observe the paper's plant; their number
/// is fixed. Accepted: those that stay in use although the error is more than twice that before.
pub(super) fn harmful(_tries: u64, _seed: u64) -> Outcome {
    let (tries, confirmed) = harmful_packages();
    Outcome { name: "harmful-packages", tries, accepted: confirmed, harm: confirmed }
}
