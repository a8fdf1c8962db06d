//! The order of an agent's packages: which may follow which, so that nothing old comes back.
//!
//! A node keeps the highest [`Serial`] that it has ever activated, whatever is in use, and accepts only
//! a higher one. "The content of version 4 in the next epoch" is how an operator goes back. A
//! package of format 1 belongs to epoch 0; its permission to replace newer versions, which needs a
//! signature, works once, because activating it moves the highest serial past every version that it
//! may replace.

use super::{Package, Refusal, Requirements, Serial};

impl Package<'_> {
    /// Returns the package's epoch and version.
    #[must_use]
    pub fn serial(&self) -> Serial {
        Serial { epoch: self.epoch, version: self.version }
    }
}

impl Requirements<'_> {
    /// Checks that a package with this serial, and this permission to replace newer versions, may
    /// follow the highest one.
    ///
    /// # Errors
    /// [`Refusal::Older`] or [`Refusal::Repeated`].
    pub fn check_serial(&self, serial: Serial, replaces: Option<u32>) -> Result<(), Refusal> {
        let Some(highest) = self.highest else { return Ok(()) };
        let is_exception = self.permission(serial, replaces).is_some_and(|newest| {
            highest.epoch == 0 && serial.version < highest.version && highest.version <= newest
        });
        if serial > highest || is_exception {
            Ok(())
        } else if serial == highest {
            Err(Refusal::Repeated { serial })
        } else {
            Err(Refusal::Older { highest, found: serial })
        }
    }

    /// Returns what [`Self::highest`] becomes when an accepted `package` is activated. A node has to
    /// store it no later than the activation itself.
    ///
    /// A permission to replace newer versions is used up by the first activation, even if that did
    /// not need it. Otherwise the same bytes could come back once a later version is in use.
    #[must_use]
    pub fn serial_after_activation(&self, package: &Package<'_>) -> Serial {
        self.serial_after(package.serial(), package.replaces)
    }

    /// Like [`Self::serial_after_activation`], for a package of which only these values are known.
    #[must_use]
    pub fn serial_after(&self, serial: Serial, replaces: Option<u32>) -> Serial {
        let used_up = self.permission(serial, replaces).map(Serial::after_exception);
        self.highest.max(Some(serial)).max(used_up).unwrap_or(serial)
    }

    /// Returns the newest version that the package may replace, if this node honours that: in epoch
    /// 0, and verified by a signature, because anyone could ask for it.
    fn permission(&self, serial: Serial, replaces: Option<u32>) -> Option<u32> {
        replaces.filter(|_| serial.epoch == 0 && self.is_signed_only())
    }
}

#[cfg(all(test, feature = "signature"))]
mod tests {
    extern crate std;

    use proptest::prelude::*;
    use std::vec::Vec;

    use super::*;
    use crate::package::signature::PublicKey;

    fn key() -> PublicKey {
        let key = ed25519_dalek::SigningKey::from_bytes(&[7; 32]);
        PublicKey::from_bytes(key.verifying_key().as_bytes()).unwrap()
    }

    const fn serial(epoch: u32, version: u32) -> Serial {
        Serial { epoch, version }
    }

    #[test]
    fn only_a_higher_serial_follows() {
        let highest = Some(serial(1, 9));
        let node = Requirements { highest, ..Requirements::ANY };
        let check = |epoch, version| node.check_serial(serial(epoch, version), None);
        assert_eq!(check(1, 10), Ok(()));
        assert_eq!(check(2, 0), Ok(()));
        let older = |found| Err(Refusal::Older { highest: serial(1, 9), found });
        assert_eq!(check(1, 8), older(serial(1, 8)));
        assert_eq!(check(0, u32::MAX), older(serial(0, u32::MAX)));
        assert_eq!(check(1, 9), Err(Refusal::Repeated { serial: serial(1, 9) }));
        assert_eq!(Requirements::ANY.check_serial(serial(0, 0), None), Ok(()));
    }

    #[test]
    fn a_permission_works_once_and_only_in_epoch_0() {
        let key = key();
        let at = |highest| Requirements {
            public_keys: core::slice::from_ref(&key),
            highest: Some(highest),
            ..Requirements::ANY
        };
        let old = serial(0, 4);
        let node = at(serial(0, 9));
        assert_eq!(node.check_serial(old, Some(9)), Ok(()));
        let after = node.serial_after(old, Some(9));
        assert_eq!(after, serial(0, 10));
        for newest in [9, 10] {
            // Neither the same bytes nor what they stepped back over.
            let again = at(after).check_serial(old, Some(9));
            assert_eq!(again, Err(Refusal::Older { highest: after, found: old }), "{newest}");
        }
        assert!(at(after).check_serial(serial(0, 5), None).is_err());
        assert!(at(after).check_serial(serial(0, 10), None).is_err());
        assert_eq!(at(after).check_serial(serial(0, 11), None), Ok(()));
        // Too narrow, without a key, from epoch 1 on, and for a package of a later format.
        assert!(node.check_serial(old, Some(8)).is_err());
        let keyless = Requirements { public_keys: &[], ..node };
        assert!(keyless.check_serial(old, Some(9)).is_err());
        assert_eq!(keyless.serial_after(serial(0, 10), Some(20)), serial(0, 10));
        assert!(at(serial(1, 9)).check_serial(old, Some(u32::MAX)).is_err());
        assert!(at(serial(1, 9)).check_serial(serial(1, 4), Some(u32::MAX)).is_err());
        // A permission for ever ends epoch 0.
        assert_eq!(node.serial_after(old, Some(u32::MAX)), serial(1, 0));
        // A permission that was not needed is used up, too.
        assert_eq!(node.serial_after(serial(0, 12), Some(20)), serial(0, 21));
    }

    /// A package as an attacker or an operator may offer it.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Offer {
        serial: Serial,
        replaces: Option<u32>,
    }

    /// A source of pseudorandom numbers: xorshift with a multiplication.
    struct Random(u64);

    impl Random {
        fn below(&mut self, bound: u32) -> u32 {
            self.0 ^= self.0 >> 12;
            self.0 ^= self.0 << 25;
            self.0 ^= self.0 >> 27;
            ((self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 32) % u64::from(bound)) as u32
        }

        fn offer(&mut self) -> Offer {
            const EDGES: [u32; 3] = [0, u32::MAX - 1, u32::MAX];
            let mut number = |bound| match self.below(8) {
                0 => EDGES[self.below(3) as usize],
                _ => self.below(bound),
            };
            let (epoch, version) = (number(4), number(12));
            let replaces = number(14);
            let is_first_format = self.below(2) == 0;
            Offer {
                serial: Serial { epoch: if is_first_format { 0 } else { epoch }, version },
                replaces: Some(replaces).filter(|_| is_first_format && replaces % 2 == 0),
            }
        }
    }

    /// Plays a history on a node: new packages, replays of any package that was activated, older
    /// and equal ones. Returns how many of the old ones were tried and accepted.
    fn replays(seed: u64, key: Option<PublicKey>) -> (u32, u32) {
        let mut random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        let (mut highest, mut activated) = (None, Vec::<Offer>::new());
        let (mut tried, mut accepted) = (0, 0);
        for _ in 0..12 {
            let node = Requirements { public_keys: key.as_slice(), highest, ..Requirements::ANY };
            let replay = random.below(2) == 0 && !activated.is_empty();
            let offer = if replay {
                activated[random.below(activated.len() as u32) as usize]
            } else {
                random.offer()
            };
            // Chance may offer an earlier package again, too.
            let was_active = activated.contains(&offer);
            let is_older = offer.replaces.is_none() && highest >= Some(offer.serial);
            let verdict = node.check_serial(offer.serial, offer.replaces);
            if was_active || is_older {
                tried += 1;
                accepted += u32::from(verdict.is_ok());
            }
            if verdict.is_ok() {
                // Whether the trial fails afterwards makes no difference: the mark stays.
                let after = node.serial_after(offer.serial, offer.replaces);
                assert!(highest.is_none_or(|before| after > before), "{seed}: {offer:?}");
                highest = Some(after);
                activated.push(offer);
            }
        }
        (tried, accepted)
    }

    fn play(histories: u64) {
        let key = key();
        let (mut tried, mut accepted) = (0, 0);
        for seed in 0..histories {
            let found = replays(seed, Some(key).filter(|_| seed % 2 == 0));
            (tried, accepted) = (tried + u64::from(found.0), accepted + u64::from(found.1));
        }
        std::println!("{histories} histories, {tried} replays, {accepted} accepted");
        assert!(tried > histories, "{tried} replays in {histories} histories");
        assert_eq!(accepted, 0);
    }

    #[test]
    fn nothing_is_accepted_again_in_a_million_histories() {
        play(1_000_000);
    }

    proptest! {
        #[test]
        fn the_highest_serial_only_rises(
            highest: Option<(u32, u32)>, package: (u32, u32), replaces: Option<u32>, signed: bool,
        ) {
            let key = key();
            let highest = highest.map(|(epoch, version)| serial(epoch, version));
            let package = serial(package.0, package.1);
            let public_keys = if signed { core::slice::from_ref(&key) } else { &[] };
            let node = Requirements { public_keys, highest, ..Requirements::ANY };
            let after = node.serial_after(package, replaces);
            prop_assert!(after >= package && Some(after) >= highest);
            let next = Requirements { highest: Some(after), ..node };
            prop_assert!(next.check_serial(package, replaces).is_err());
        }
    }
}
