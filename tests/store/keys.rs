//! Keys and epochs in the journal: they survive power cuts at every word, and an epoch is handed out
//! once.

use agent_core::AgentId;
use agent_core::package::signature::PublicKey;
use agent_core::store::{Store, StoreError};
use agent_core::wire::authentic::NetworkKey;
use agent_core::wire::secret::Secret;
use rayon::prelude::*;

use test_support::nor_flash::{SimulatedFlash, Tear};
use test_support::store_model::{check, erased_flash, layout};

/// Words of 8 bytes, and room for seven records in a half.
type Flash = SimulatedFlash<8, 896>;

/// What a node of this test knows.
#[derive(Clone, Debug, PartialEq)]
struct Known {
    network_keys: Vec<NetworkKey>,
    port_key: Option<(Secret, AgentId)>,
    /// Whether the public key of the firmware is valid, and whether the other one is.
    operators: [bool; 2],
}

impl Known {
    /// Only the firmware's public key.
    const BLANK: Self = Self { network_keys: vec![], port_key: None, operators: [true, false] };
}

/// The public key of the firmware, and another one: those of the first two tests of RFC 8032, 7.1.
fn public_keys() -> [PublicKey; 2] {
    [
        *b"\xd7\x5a\x98\x01\x82\xb1\x0a\xb7\xd5\x4b\xfe\xd3\xc9\x64\x07\x3a\
           \x0e\xe1\x72\xf3\xda\xa6\x23\x25\xaf\x02\x1a\x68\xf7\x07\x51\x1a",
        *b"\x3d\x40\x17\xc3\xe8\x43\x89\x5a\x92\xb7\x0a\xa7\x4d\x1b\x7e\xbc\
           \x9c\x98\x2c\xcf\x2e\xc4\x96\x8c\xc0\xcd\x55\xf1\x2a\xf4\x66\x0c",
    ]
    .map(|bytes| PublicKey::from_bytes(&bytes).unwrap())
}

/// The keys as a request has them.
fn ring(numbers: &[u8]) -> Vec<u8> {
    numbers.iter().flat_map(|&number| [&[number][..], &[number ^ 0x5a; 16]].concat()).collect()
}

fn key(number: u8) -> NetworkKey {
    NetworkKey::new(number, Secret::new([number ^ 0x5a; 16]))
}

fn boot(flash: &mut Flash) -> (Store<&mut Flash>, Known) {
    let mut store = Store::open(flash, layout(896, 1)).unwrap();
    store.load(check);
    let network_keys = store.network_keys().to_vec();
    let port_key = store.port_key();
    let [built_in, other] = public_keys();
    let found = store.operator_keys(built_in);
    let operators = [built_in, other].map(|key| found.contains(&key));
    (store, Known { network_keys, port_key, operators })
}

/// The `turn`-th change of keys, and what the node knows after it.
fn change(
    store: &mut Store<&mut Flash>,
    known: &Known,
    turn: u8,
) -> (Result<(), StoreError>, Known) {
    match turn % 5 {
        0 => {
            let port_key = (Secret::new([turn | 1; 16]), turn.into());
            let after = Known { port_key: Some(port_key), ..known.clone() };
            (store.record_port_key(port_key.0, port_key.1), after)
        }
        1 => {
            let network_keys = vec![key(turn)];
            (store.record_network_keys(&ring(&[turn])), Known { network_keys, ..known.clone() })
        }
        2 => {
            let network_keys = vec![key(turn), key(turn - 1)];
            (
                store.record_network_keys(&ring(&[turn, turn - 1])),
                Known { network_keys, ..known.clone() },
            )
        }
        3 => {
            let is_overlap = turn % 2 == 1;
            let [_, other] = public_keys();
            let bytes = [&[is_overlap.into()][..], other.as_bytes()].concat();
            let after = Known { operators: [is_overlap, true], ..known.clone() };
            (store.record_operator_keys(&bytes), after)
        }
        _ => (store.remove_keys(), Known::BLANK),
    }
}

#[test]
fn keys_and_epochs_survive_power_cuts_at_every_word() {
    let cases: Vec<_> =
        Tear::ALL.into_iter().flat_map(|tear| [false, true].map(|ecc| (tear, ecc))).collect();
    let cuts: usize = cases.par_iter().map(|&(tear, ecc)| cut_everywhere(tear, ecc)).sum();
    println!("{cuts} power cuts");
    assert!(cuts > 5_000);
}

fn cut_everywhere(tear: Tear, has_correction: bool) -> usize {
    const BLOCK: u32 = 4;
    let mut cuts = 0;
    for energy in (0..).step_by(8) {
        let mut flash: Flash = erased_flash(1, tear, 9).with_correction(has_correction);
        let (mut known, mut attempted, mut used, mut turn) = (Known::BLANK, vec![], 0, 0);
        let mut is_cut = false;
        while turn < 18 {
            // The power fails once, and again in the boot after it.
            let supply = match is_cut {
                false => Some(energy),
                true if cuts % 3 == 0 => Some(energy % 320),
                true => None,
            };
            flash.power_on(supply);
            let (mut store, found) = boot(&mut flash);
            if !store.flash().power_lost {
                let is_known = found == known || attempted.contains(&found);
                assert!(is_known, "{found:?} after {known:?} and {attempted:?}");
                (known, attempted) = (found, vec![]);
            }
            while !store.flash().power_lost && turn < 18 {
                if let Ok((first, end)) = store.reserve_epochs(BLOCK) {
                    assert!(first >= used && end == first + BLOCK, "epoch {first} after {used}");
                    used = end;
                } else {
                    assert!(store.flash().power_lost);
                    break;
                }
                let (outcome, after) = change(&mut store, &known, turn);
                turn += 1;
                if outcome.is_ok() {
                    known = after;
                    continue;
                }
                assert!(store.flash().power_lost, "{outcome:?}");
                // A reset removes network keys first, the port key last.
                let unkeyed = Known { network_keys: vec![], ..known.clone() };
                attempted =
                    vec![after, unkeyed.clone(), Known { operators: [true, false], ..unkeyed }];
            }
            if !flash.power_lost {
                continue;
            }
            is_cut = true;
            cuts += 1;
        }
        if !is_cut {
            return cuts;
        }
    }
    unreachable!("some energy is enough")
}

#[test]
fn what_cannot_be_a_key_ring_is_refused() {
    let mut flash: Flash = erased_flash(1, Tear::Prefix, 9);
    let (mut store, known) = boot(&mut flash);
    assert_eq!(known, Known::BLANK);
    for keys in [vec![], ring(&[1, 1]), ring(&[1, 2, 3]), ring(&[1])[1..].to_vec()] {
        assert_eq!(store.record_network_keys(&keys), Err(StoreError::Note));
    }
    assert_eq!(store.reserve_epochs(3), Ok((0, 3)));
    // Provisioning sets the epoch from the host's clock; an earlier one changes nothing.
    assert_eq!(store.skip_epochs(1_000), Ok(()));
    assert_eq!(store.skip_epochs(2), Ok(()));
    assert_eq!(store.reserve_epochs(2), Ok((1_000, 1_002)));
    store.record_port_key(Secret::new([7; 16]), 3).unwrap();
    store.record_network_keys(&ring(&[1])).unwrap();
    store.remove_keys().unwrap();
    let (mut store, known) = boot(&mut flash);
    assert_eq!(known, Known::BLANK);
    assert_eq!(store.reserve_epochs(1), Ok((1_002, 1_003)), "a reset keeps the epochs");
    assert_eq!(store.reserve_epochs(u32::MAX), Err(StoreError::Note));
}

#[test]
fn keys_are_not_printed() {
    let secret = format!("{:?}", NetworkKey::new(7, Secret::new([0xab; 16])));
    assert!(secret.contains('7') && !secret.contains("171") && !secret.contains("ab"), "{secret}");
}
