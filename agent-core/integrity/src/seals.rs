//! The cipher of sealed requests and the hash of authentic frames.
//!
//! | function | algorithm | on a Cortex-M4 |
//! | --- | --- | --- |
//! | [`encrypt`], [`decrypt`] | Ascon-AEAD128 (NIST SP 800-232), of the crate `ascon-aead` | about 100 instructions per byte |
//! | [`hash`] | SipHash-2-4 (Aumasson and Bernstein 2012) | about 30 instructions per byte |
//!
//! SipHash is written here because it takes less than half of the flash that the crate `siphasher`
//! takes: see docs/decisions/0020-keys.md. Tests compare the two.

use ascon_aead::aead::{AeadInOut, KeyInit};
use ascon_aead::{AsconAead128, AsconAead128Key, AsconAead128Nonce, AsconAead128Tag};

/// Length of keys, nonces and tags. \[byte\]
pub const LENGTH: usize = 16;

/// Encrypts `bytes` in place and returns the tag. A nonce must never come again with the same key.
#[inline(never)]
#[must_use]
pub fn encrypt(key: &[u8; LENGTH], nonce: &[u8; LENGTH], bytes: &mut [u8]) -> [u8; LENGTH] {
    let cipher = AsconAead128::new(&AsconAead128Key::from(*key));
    let nonce = AsconAead128Nonce::from(*nonce);
    // Only messages longer than 2^64 bytes fail.
    cipher.encrypt_inout_detached(&nonce, &[], bytes.into()).map_or([0; LENGTH], Into::into)
}

/// Decrypts `bytes` in place; returns whether the tag matches. If not, the bytes hold no message.
#[inline(never)]
#[must_use]
pub fn decrypt(
    key: &[u8; LENGTH],
    nonce: &[u8; LENGTH],
    bytes: &mut [u8],
    tag: &[u8; LENGTH],
) -> bool {
    let cipher = AsconAead128::new(&AsconAead128Key::from(*key));
    let (nonce, tag) = (AsconAead128Nonce::from(*nonce), AsconAead128Tag::from(*tag));
    cipher.decrypt_inout_detached(&nonce, &[], bytes.into(), &tag).is_ok()
}

/// Returns the keyed hash of `bytes`.
#[inline(never)]
#[must_use]
pub fn hash(key: &[u8; LENGTH], bytes: &[u8]) -> u64 {
    let [low, high] = halves(key);
    let mut state = [
        low ^ 0x736f_6d65_7073_6575,
        high ^ 0x646f_7261_6e64_6f6d,
        low ^ 0x6c79_6765_6e65_7261,
        high ^ 0x7465_6462_7974_6573,
    ];
    let (words, rest) = bytes.as_chunks();
    // The last word has the last bytes, and the length in its highest byte.
    let mut last = [0; 8];
    last.iter_mut().zip(rest).for_each(|(place, byte)| *place = *byte);
    let last = u64::from_le_bytes(last) | (bytes.len() as u64) << 56;
    let words = words.iter().map(|word| u64::from_le_bytes(*word));
    for word in words.chain([last]) {
        state[3] ^= word;
        rounds(&mut state, 2);
        state[0] ^= word;
    }
    state[2] ^= 0xff;
    rounds(&mut state, 4);
    let [v0, v1, v2, v3] = state;
    v0 ^ v1 ^ v2 ^ v3
}

fn halves(key: &[u8; LENGTH]) -> [u64; 2] {
    let key = u128::from_le_bytes(*key);
    [key as u64, (key >> 64) as u64]
}

fn rounds(state: &mut [u64; 4], count: u32) {
    let [mut v0, mut v1, mut v2, mut v3] = *state;
    for _ in 0..count {
        v0 = v0.wrapping_add(v1);
        v2 = v2.wrapping_add(v3);
        v1 = v1.rotate_left(13) ^ v0;
        v3 = v3.rotate_left(16) ^ v2;
        v0 = v0.rotate_left(32);
        v2 = v2.wrapping_add(v1);
        v0 = v0.wrapping_add(v3);
        v1 = v1.rotate_left(17) ^ v2;
        v3 = v3.rotate_left(21) ^ v0;
        v2 = v2.rotate_left(32);
    }
    *state = [v0, v1, v2, v3];
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn counting<const N: usize>() -> [u8; N] {
        core::array::from_fn(|i| i as u8)
    }

    /// From the algorithm's list of known answers (`LWC_AEAD_KAT_128_128.txt`, count 1).
    #[test]
    fn the_cipher_is_the_standard_one() {
        let tag = encrypt(&counting(), &counting(), &mut []);
        let expected = [
            0x44, 0x27, 0xd6, 0x4b, 0x8e, 0x1e, 0x14, 0x51, 0xfc, 0x44, 0x59, 0x60, 0xf0, 0x83,
            0x9b, 0xb0,
        ];
        assert_eq!(tag, expected);
    }

    /// The example in the algorithm's paper.
    #[test]
    fn the_hash_is_the_one_of_its_paper() {
        assert_eq!(hash(&counting(), &counting::<15>()), 0xa129_ca61_49be_45e5);
    }

    proptest! {
        #[test]
        fn the_hash_is_that_of_the_crate_siphasher(
            key: [u8; LENGTH], bytes in prop::collection::vec(any::<u8>(), 0..130),
        ) {
            let expected = siphasher::sip::SipHasher24::new_with_key(&key).hash(&bytes);
            prop_assert_eq!(hash(&key, &bytes), expected);
        }

        #[test]
        fn decrypting_undoes_encrypting(
            key: [u8; LENGTH], nonce: [u8; LENGTH], bit: prop::sample::Index,
            bytes in prop::collection::vec(any::<u8>(), 0..170),
        ) {
            let mut sealed = bytes.clone();
            let tag = encrypt(&key, &nonce, &mut sealed);
            let mut opened = sealed.clone();
            prop_assert!(decrypt(&key, &nonce, &mut opened, &tag));
            prop_assert_eq!(opened, bytes);
            let mut all = [&sealed[..], &tag].concat();
            let bit = bit.index(8 * all.len());
            all[bit / 8] ^= 1 << (bit % 8);
            let (changed, tag) = all.split_last_chunk_mut().unwrap();
            prop_assert!(!decrypt(&key, &nonce, changed, tag));
        }
    }
}
