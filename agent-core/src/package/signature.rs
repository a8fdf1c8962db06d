//! Authenticates weight packages with Ed25519 signatures (RFC 8032).
//!
//! A checksum detects damage but not manipulation, because anyone who can write to a node's flash
//! can compute one. A node that has its operator's [`PublicKey`] accepts only packages signed with
//! the private key, which never leaves the host. All data here is public, so constant-time code is
//! not needed.
//!
//! Refused in addition to what the equation refuses:
//!
//! | input | reason |
//! | --- | --- |
//! | a key that is not a point, or not canonically encoded | RFC 8032, 5.1.3 |
//! | a key of small order | signatures can be made for it without any private key |
//! | `S` not below the order `L` of the group | anyone could turn a signature into another (RFC 8032, 5.1.7) |
//! | an `R` that is not a point, not canonical, or of small order | no signer produces one |
//!
//! The equation is the cofactored one, `8 S B = 8 R + 8 k A`, which RFC 8032 prefers. Verifiers
//! without the cofactor differ only on signatures that the owner of the private key crafted for
//! that purpose.
//!
//! The cargo feature `signature` enables the verifier. Without it a [`PublicKey`] cannot be
//! constructed, so an `Option<&PublicKey>` is always `None` and its code is eliminated.
//!
//! Cost on a Cortex-M4, opt-level `s`: 17.5 kB of flash, 6.1 kB of stack, 1.66 million instructions
//! plus 157 per byte of the message; `docs/decisions/0006-signatures.md` has the measurement.
//! Invariant: no panic for any key, signature, and message below 512 MiB.

use crate::wire::crc::CHECKSUM_LENGTH;

/// Length of a signature in bytes: `R`, then `S`, little-endian.
pub const SIGNATURE_LENGTH: usize = 64;

/// Length of a signature with its checksum. \[bytes\]
pub const SIGNATURE_BLOCK_LENGTH: usize = SIGNATURE_LENGTH + CHECKSUM_LENGTH;

/// Length of a public key in bytes: a compressed point of the curve.
pub const PUBLIC_KEY_LENGTH: usize = 32;

/// The key that packages must be signed with: a canonical point that is not of small order.
///
/// Its constructor `from_bytes` requires the cargo feature `signature`; without it the type has no
/// values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublicKey(Encoded);

#[cfg(feature = "signature")]
type Encoded = [u8; PUBLIC_KEY_LENGTH];
#[cfg(not(feature = "signature"))]
type Encoded = core::convert::Infallible;

/// Why bytes are not a public key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PublicKeyError {
    /// They do not encode a point of the curve, or not canonically.
    NotAPoint,
    /// The point is one of the eight for which signatures can be forged without a private key.
    SmallOrder,
}

impl core::fmt::Display for PublicKeyError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::NotAPoint => "not an Ed25519 public key",
            Self::SmallOrder => "weak public key: anyone could forge signatures for it",
        })
    }
}

impl core::error::Error for PublicKeyError {}

/// The signature was not made for this message with this key.
///
/// Changed bytes, another key and a forgery cannot be told apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SignatureMismatch;

impl core::fmt::Display for SignatureMismatch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the signature does not match")
    }
}

impl core::error::Error for SignatureMismatch {}

impl PublicKey {
    /// Decodes a public key.
    ///
    /// # Errors
    /// [`PublicKeyError::NotAPoint`] or [`PublicKeyError::SmallOrder`].
    #[cfg(feature = "signature")]
    pub fn from_bytes(bytes: &[u8; PUBLIC_KEY_LENGTH]) -> Result<Self, PublicKeyError> {
        match ed25519_compact::PublicKey::new(*bytes).validate() {
            Ok(()) => Ok(Self(*bytes)),
            Err(ed25519_compact::Error::WeakPublicKey) => Err(PublicKeyError::SmallOrder),
            Err(_) => Err(PublicKeyError::NotAPoint),
        }
    }

    /// Decodes a public key; there is none without the `signature` feature.
    #[cfg(feature = "authentic-frames")]
    pub(crate) fn decoded(bytes: &[u8; PUBLIC_KEY_LENGTH]) -> Option<Self> {
        #[cfg(feature = "signature")]
        return Self::from_bytes(bytes).ok();
        #[cfg(not(feature = "signature"))]
        {
            let _ = bytes;
            None
        }
    }

    /// Returns the encoded point.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8; PUBLIC_KEY_LENGTH] {
        #[cfg(feature = "signature")]
        {
            &self.0
        }
        #[cfg(not(feature = "signature"))]
        match self.0 {}
    }
}

/// Checks that `signature` was made for the whole of `message` by the owner of `key`.
///
/// # Errors
/// [`SignatureMismatch`] if not; the message is then untrusted.
pub fn verify(
    key: &PublicKey,
    message: &[u8],
    signature: &[u8; SIGNATURE_LENGTH],
) -> Result<(), SignatureMismatch> {
    #[cfg(feature = "signature")]
    {
        ed25519_compact::PublicKey::new(key.0)
            .verify(message, &ed25519_compact::Signature::new(*signature))
            .map_err(|_| SignatureMismatch)
    }
    #[cfg(not(feature = "signature"))]
    {
        let (_, _) = (message, signature);
        match key.0 {}
    }
}

#[cfg(all(test, feature = "signature"))]
mod tests {
    use super::*;
    use ed25519_dalek::{Signer, SigningKey, VerifyingKey};

    /// Decodes hexadecimal digits, most significant byte first.
    fn hex<const LENGTH: usize>(digits: &str) -> [u8; LENGTH] {
        assert_eq!(digits.len(), 2 * LENGTH, "{digits}");
        core::array::from_fn(|i| u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).unwrap())
    }

    /// RFC 8032, section 7.1: private key, public key, message, signature.
    const RFC_8032: [(&str, &str, &[u8], &str); 4] = [
        (
            "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
            "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
            &[],
            "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e06522490155\
             5fb8821590a33bacc61e39701cf9b46bd25bf5f0595bbe24655141438e7a100b",
        ),
        (
            "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
            "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
            &[0x72],
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da\
             085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00",
        ),
        (
            "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7",
            "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
            &[0xaf, 0x82],
            "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac\
             18ff9b538d16f290ae67f760984dc6594a7c15e9716ed28dc027beceea1ec40a",
        ),
        (
            "833fe62409237b9d62ec77587520911e9a759cec1d19755b7da901b96dca3d42",
            "ec172b93ad5e563bf4932c70e1245034c35467ef2efd4d64ebf819683467e2bf",
            // SHA-512 of "abc".
            &[
                0xdd, 0xaf, 0x35, 0xa1, 0x93, 0x61, 0x7a, 0xba, 0xcc, 0x41, 0x73, 0x49, 0xae, 0x20,
                0x41, 0x31, 0x12, 0xe6, 0xfa, 0x4e, 0x89, 0xa9, 0x7e, 0xa2, 0x0a, 0x9e, 0xee, 0xe6,
                0x4b, 0x55, 0xd3, 0x9a, 0x21, 0x92, 0x99, 0x2a, 0x27, 0x4f, 0xc1, 0xa8, 0x36, 0xba,
                0x3c, 0x23, 0xa3, 0xfe, 0xeb, 0xbd, 0x45, 0x4d, 0x44, 0x23, 0x64, 0x3c, 0xe8, 0x0e,
                0x2a, 0x9a, 0xc9, 0x4f, 0xa5, 0x4c, 0xa4, 0x9f,
            ],
            "dc2a4459e7369633a52b1bf277839a00201009a3efbf3ecb69bea2186c26b589\
             09351fc9ac90b3ecfdfbc7c66431e0303dca179c138ac17ad9bef1177331a704",
        ),
    ];

    /// The order of the group, little-endian (RFC 8032, section 5.1).
    const L: [u8; 32] = {
        let mut bytes = [0; 32];
        let low: u128 = 0x14de_f9de_a2f7_9cd6_5812_631a_5cf5_d3ed;
        let mut i = 0;
        while i < 16 {
            bytes[i] = low.to_le_bytes()[i];
            i += 1;
        }
        bytes[31] = 0x10;
        bytes
    };

    /// The canonical encodings of all points of small order.
    const SMALL_ORDER: [&str; 8] = [
        "0100000000000000000000000000000000000000000000000000000000000000",
        "ecffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
        "0000000000000000000000000000000000000000000000000000000000000000",
        "0000000000000000000000000000000000000000000000000000000000000080",
        "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05",
        "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc85",
        "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a",
        "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac03fa",
    ];
    /// Encodings of no point, or non-canonical ones.
    const NOT_A_POINT: [&str; 8] = [
        // y = p and y = p + 1, which stand for 0 and 1, with either sign.
        "edffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
        "edffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff",
        "eeffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
        "eeffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff",
        // x = 0 has no second sign.
        "0100000000000000000000000000000000000000000000000000000000000080",
        "ecffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff",
        // y = 2 is on no point of the curve; y = 2^255 - 1 is above p.
        "0200000000000000000000000000000000000000000000000000000000000000",
        "ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f",
    ];

    /// Deterministic bytes for keys and messages: SplitMix64.
    struct Bytes(u64);

    impl Bytes {
        fn next(&mut self) -> u8 {
            self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            (z >> 56) as u8
        }

        fn array<const LENGTH: usize>(&mut self) -> [u8; LENGTH] {
            core::array::from_fn(|_| self.next())
        }
    }

    /// Returns a key, a message and its signature from the independent signer.
    fn signed(seed: u64) -> (PublicKey, [u8; 40], [u8; SIGNATURE_LENGTH]) {
        let mut bytes = Bytes(seed);
        let signer = SigningKey::from_bytes(&bytes.array());
        let message = bytes.array();
        let key = PublicKey::from_bytes(signer.verifying_key().as_bytes()).unwrap();
        (key, message, signer.sign(&message).to_bytes())
    }

    #[test]
    fn accepts_the_vectors_of_the_standard() {
        for (private, public, message, signature) in RFC_8032 {
            let signature = hex(signature);
            let key = PublicKey::from_bytes(&hex(public)).unwrap();
            assert_eq!(verify(&key, message, &signature), Ok(()), "{public}");
            // The private key ties the vector to its public key and signature.
            let signer = SigningKey::from_bytes(&hex(private));
            assert_eq!(signer.verifying_key().as_bytes(), key.as_bytes());
            assert_eq!(signer.sign(message).to_bytes(), signature);
        }
    }

    #[test]
    fn every_changed_bit_is_refused() {
        let (key, message, signature) = signed(1);
        assert_eq!(verify(&key, &message, &signature), Ok(()));
        for bit in 0..8 * message.len() {
            let mut changed = message;
            changed[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(verify(&key, &changed, &signature), Err(SignatureMismatch), "bit {bit}");
        }
        for bit in 0..8 * SIGNATURE_LENGTH {
            let mut changed = signature;
            changed[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(verify(&key, &message, &changed), Err(SignatureMismatch), "bit {bit}");
        }
        for bit in 0..8 * PUBLIC_KEY_LENGTH {
            let mut changed = *key.as_bytes();
            changed[bit / 8] ^= 1 << (bit % 8);
            let accepted = PublicKey::from_bytes(&changed)
                .is_ok_and(|key| verify(&key, &message, &signature).is_ok());
            assert!(!accepted, "bit {bit}");
        }
    }

    #[test]
    fn a_shorter_or_longer_message_is_refused() {
        let (key, message, signature) = signed(2);
        let (longer, end) = (message.len() + 1, message.len() - 1);
        let mut padded = [0; 41];
        padded[..message.len()].copy_from_slice(&message);
        assert_eq!(padded.len(), longer);
        assert!(verify(&key, &padded, &signature).is_err());
        assert!(verify(&key, &message[..end], &signature).is_err());
        assert!(verify(&key, &[], &signature).is_err());
    }

    #[test]
    fn adding_the_order_to_a_signature_is_refused() {
        let (key, message, mut signature) = signed(3);
        assert!(verify(&key, &message, &signature).is_ok());
        // S + 14 L is the last that fits into 32 bytes for every S below L.
        for multiple in 1..=14 {
            let mut carry = 0;
            for (byte, order) in signature[32..].iter_mut().zip(L) {
                let sum = u16::from(*byte) + u16::from(order) + carry;
                *byte = sum as u8;
                carry = sum >> 8;
            }
            assert_eq!(carry, 0, "S + {multiple} L does not fit");
            assert!(verify(&key, &message, &signature).is_err(), "S + {multiple} L");
        }
    }

    #[test]
    fn weak_keys_are_refused() {
        for key in SMALL_ORDER {
            let refused = PublicKey::from_bytes(&hex(key));
            assert_eq!(refused, Err(PublicKeyError::SmallOrder), "{key}");
        }
        for key in NOT_A_POINT {
            let refused = PublicKey::from_bytes(&hex(key));
            assert_eq!(refused, Err(PublicKeyError::NotAPoint), "{key}");
        }
    }

    #[test]
    fn commitments_that_no_signer_produces_are_refused() {
        let (key, message, mut signature) = signed(4);
        for commitment in SMALL_ORDER.iter().chain(&NOT_A_POINT) {
            signature[..32].copy_from_slice(&hex::<32>(commitment));
            for s in [[0; 32], L] {
                let mut forged = signature;
                forged[32..].copy_from_slice(&s);
                assert!(verify(&key, &message, &forged).is_err(), "{commitment}");
            }
        }
    }

    /// Lengths 0 to 383 reach every offset in the hash's blocks of 128 bytes.
    #[test]
    fn agrees_with_an_independent_implementation() {
        let mut bytes = Bytes(5);
        let message: [u8; 384] = bytes.array();
        for length in 0..message.len() {
            let message = &message[..length];
            let signer = SigningKey::from_bytes(&bytes.array());
            let theirs = signer.verifying_key();
            let ours = PublicKey::from_bytes(theirs.as_bytes()).unwrap();
            let mut signature = signer.sign(message);
            assert_eq!(verify(&ours, message, &signature.to_bytes()), Ok(()), "{length} bytes");

            let mut changed = signature.to_bytes();
            changed[usize::from(bytes.next() % 64)] ^= 1 << (bytes.next() % 8);
            signature = ed25519_dalek::Signature::from_bytes(&changed);
            assert_eq!(
                verify(&ours, message, &changed).is_ok(),
                theirs.verify_strict(message, &signature).is_ok(),
                "{length} bytes"
            );
        }
    }

    /// About half of all byte strings are points.
    #[test]
    fn agrees_on_valid_keys() {
        let mut bytes = Bytes(6);
        let mut points = 0;
        for _ in 0..400 {
            let candidate = bytes.array();
            let ours = PublicKey::from_bytes(&candidate);
            let theirs = VerifyingKey::from_bytes(&candidate).is_ok_and(|key| !key.is_weak());
            assert_eq!(ours.is_ok(), theirs, "{candidate:02x?}");
            points += usize::from(theirs);
        }
        assert!((150..250).contains(&points), "{points} points");
    }
}
