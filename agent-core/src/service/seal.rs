//! Requests that only an operator with the node's port key can make.
//!
//! A node that has a port key carries out a request only if it is sealed, except those of
//! [`Request::is_free`](super::Request::is_free). Sealing encrypts the request and adds a tag over it
//! (Ascon-AEAD128, NIST SP 800-232). The nonce has the node's epoch, which never comes again, the request's counter,
//! which rises, and a random salt; so no request can be read, changed, repeated or delayed beyond the
//! next one.
//!
//! | on the wire | |
//! | --- | --- |
//! | [`Request::Numbered`](super::Request::Numbered) | as for any request; may be missing |
//! | [`Request::Sealed`](super::Request::Sealed) | its index, the counter as a varint, and the salt, eight bytes |
//! | encrypted request | as long as the request |
//! | tag | [`TAG_LENGTH`] bytes |
//!
//! | Ascon-AEAD128 | |
//! | --- | --- |
//! | key | derived from the port key |
//! | nonce | epoch, then counter, `u32` each, little-endian, then the salt |
//! | associated data | none |
//!
//! Before its first request, a laptop asks for the [`Session`], which states the epoch and proves that
//! the node has the port key. So a laptop never seals requests for an epoch that is still to
//! come. Answers are not sealed.
//!
//! Cost: about 100 instructions per byte on a Cortex-M4.

use super::{Seal, Session};
use crate::wire::secret::{Purpose, Secret};

/// Length of the tag of a sealed request. \[byte\]
pub const TAG_LENGTH: usize = integrity::LENGTH;

/// The key of a node's service port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PortKey(Secret);

impl PortKey {
    /// Creates the key from the secret that node and operator share.
    #[must_use]
    pub const fn new(secret: Secret) -> Self {
        Self(secret)
    }

    /// Returns the proof that a node with this key has reported this `session`, whose own proof does not
    /// matter.
    #[must_use]
    pub fn proof(&self, session: &Session) -> u64 {
        let &Session { agent, epoch, counter, network_keys: [first, second], .. } = session;
        let [e0, e1, e2, e3] = epoch.unwrap_or(u32::MAX).to_le_bytes();
        let [c0, c1, c2, c3] = counter.to_le_bytes();
        let (first, second) = (first.unwrap_or(0), second.unwrap_or(0));
        let told = [e0, e1, e2, e3, c0, c1, c2, c3, first, second];
        self.0.derive(Purpose::Proof, agent).hash(&told)
    }

    /// Encrypts the `request` in place and returns its tag.
    #[must_use]
    pub fn seal(&self, epoch: u32, seal: &Seal, request: &mut [u8]) -> [u8; TAG_LENGTH] {
        integrity::encrypt(&self.request_key(), &nonce(epoch, seal), request)
    }

    /// Decrypts in place what [`Self::seal`] has made; `None` if the tag does not match. The bytes then
    /// hold no request.
    #[must_use]
    pub fn open<'b>(&self, epoch: u32, seal: &Seal, sealed: &'b mut [u8]) -> Option<&'b [u8]> {
        let (request, tag) = sealed.split_last_chunk_mut::<TAG_LENGTH>()?;
        integrity::decrypt(&self.request_key(), &nonce(epoch, seal), request, tag)
            .then_some(&*request)
    }

    fn request_key(&self) -> [u8; integrity::LENGTH] {
        self.0.derive(Purpose::Request, 0).to_bytes()
    }
}

fn nonce(epoch: u32, &Seal { counter, salt }: &Seal) -> [u8; integrity::LENGTH] {
    let [e0, e1, e2, e3] = epoch.to_le_bytes();
    let [c0, c1, c2, c3] = counter.to_le_bytes();
    let [s0, s1, s2, s3, s4, s5, s6, s7] = salt;
    [e0, e1, e2, e3, c0, c1, c2, c3, s0, s1, s2, s3, s4, s5, s6, s7]
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    const KEY: PortKey = PortKey::new(Secret::new([7; 16]));

    fn sealed(key: &PortKey, epoch: u32, seal: &Seal, request: &[u8]) -> Vec<u8> {
        let mut bytes = request.to_vec();
        let tag = key.seal(epoch, seal, &mut bytes);
        bytes.extend(tag);
        bytes
    }

    #[test]
    fn the_proof_depends_on_the_key_and_on_all_that_is_told() {
        let session = Session {
            agent: 1,
            epoch: Some(2),
            counter: 3,
            proof: 0,
            network_keys: [Some(4), None],
        };
        let others = [
            Session { agent: 2, ..session },
            Session { epoch: Some(3), ..session },
            Session { epoch: None, ..session },
            Session { counter: 4, ..session },
            Session { network_keys: [None, Some(4)], ..session },
        ];
        let proof = KEY.proof(&session);
        assert_eq!(proof, KEY.proof(&Session { proof, ..session }));
        for other in others {
            assert_ne!(proof, KEY.proof(&other), "{other:?}");
        }
        assert_ne!(proof, PortKey::new(Secret::new([8; 16])).proof(&session));
    }

    proptest! {
        #[test]
        fn opening_undoes_sealing(
            bits: [u8; 16], epoch: u32, counter: u32, salt: [u8; 8],
            request in prop::collection::vec(any::<u8>(), 0..140),
        ) {
            let key = PortKey::new(Secret::new(bits));
            let seal = Seal { counter, salt };
            let mut bytes = sealed(&key, epoch, &seal, &request);
            prop_assert_eq!(key.open(epoch, &seal, &mut bytes), Some(&request[..]));
        }

        #[test]
        fn anything_else_is_refused(
            epoch: u32, counter: u32, salt: [u8; 8], request in prop::collection::vec(any::<u8>(), 0..40),
            bit: prop::sample::Index, length: prop::sample::Index, other: (u32, u32, [u8; 8]),
        ) {
            let bytes = sealed(&KEY, epoch, &Seal { counter, salt }, &request);
            let refused = |key: &PortKey, (epoch, counter, salt), bytes: &[u8]| {
                key.open(epoch, &Seal { counter, salt }, &mut bytes.to_vec()).is_none()
            };
            let here = (epoch, counter, salt);
            let mut changed = bytes.clone();
            let bit = bit.index(8 * bytes.len());
            changed[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(refused(&KEY, here, &changed));
            prop_assert!(refused(&KEY, here, &bytes[..length.index(bytes.len())]));
            prop_assert!(refused(&PortKey::new(Secret::new([8; 16])), here, &bytes));
            // Each part of the nonce by itself.
            for there in
                [(other.0, counter, salt), (epoch, other.1, salt), (epoch, counter, other.2)]
            {
                prop_assert!(there == here || refused(&KEY, there, &bytes));
            }
        }
    }
}
