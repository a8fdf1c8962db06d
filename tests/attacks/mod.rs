//! Attacks on a node: what a stranger can do, tried many times, and the outcome.
//!
//! Each attack is a function of the number of tries and a seed that returns an [`Outcome`].
//! `cargo xtask attack` runs them all with many tries ([`report`]) and prints the outcomes; the
//! ordinary test [`every_attack_fails`] runs each with a few. `docs/threat-model.md` says who could
//! make them.

#[cfg(unix)]
mod emulated;
mod faults;
mod packages;
mod port;
mod radio;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde_json::json;

/// The outcome of an attack.
#[derive(Debug)]
struct Outcome {
    /// Its name in the report and in the threat model.
    name: &'static str,
    /// Number of frames, requests, packages or faults tried.
    tries: u64,
    /// Number of those that a node accepted although it should not have.
    accepted: u64,
    /// Number of harmful effects on a node: see each attack.
    harm: u64,
}

/// An attack with a number of tries and a seed.
type Attack = fn(u64, u64) -> Outcome;

/// All attacks, with the number of tries in an ordinary test; 0 for those whose number is fixed and
/// that are ordinary tests of their own, and for those that need emulators.
const ATTACKS: &[(Attack, u64)] = &[
    (radio::stranger, 20_000),
    (port::stranger, 20_000),
    #[cfg(unix)]
    (emulated::with_a_radio, 0),
    #[cfg(unix)]
    (emulated::at_the_port, 0),
    (packages::replayed, 20_000),
    (packages::harmful, 0),
    (faults::flipped_bits, 0),
    (faults::power_cuts, 0),
];

#[test]
fn every_attack_fails() {
    for &(attack, tries) in ATTACKS.iter().filter(|(_, tries)| *tries > 0) {
        let outcome = attack(tries, 1);
        assert!(outcome.tries >= tries, "{outcome:?}");
        assert_eq!((outcome.accepted, outcome.harm), (0, 0), "{outcome:?}");
    }
}

/// Makes all attacks with `ATTACK_TRIES` tries each and writes the outcomes to the file
/// `ATTACK_REPORT`: see `cargo xtask attack`.
#[test]
#[ignore = "`cargo xtask attack` runs it"]
fn report() {
    let number = |name| std::env::var(name).ok().and_then(|value| value.parse().ok());
    let (tries, seed) = (number("ATTACK_TRIES").unwrap(), number("ATTACK_SEED").unwrap());
    let attacks = ATTACKS.iter().map(|(attack, _)| {
        let Outcome { name, tries, accepted, harm } = attack(tries, seed);
        eprintln!("{name}: {tries} tries, {accepted} accepted, {harm} harmful");
        json!({"name": name, "tries": tries, "accepted": accepted, "harm": harm})
    });
    let report = json!({"attacks": attacks.collect::<Vec<_>>()});
    std::fs::write(std::env::var_os("ATTACK_REPORT").unwrap(), report.to_string()).unwrap();
}

/// Changes a recording: flips a bit, cuts its end, or puts the last `tag` bytes of another behind it.
fn alter(bytes: &mut Vec<u8>, other: &[u8], tag: usize, random: &mut ChaCha8Rng) {
    match random.random_range(0..3) {
        0 => {
            let bit = random.random_range(0..8 * bytes.len());
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        1 => bytes.truncate(random.random_range(0..bytes.len())),
        _ => {
            bytes.truncate(bytes.len().saturating_sub(tag));
            bytes.extend(&other[other.len().saturating_sub(tag)..]);
        }
    }
}
