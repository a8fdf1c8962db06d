//! Fuzzes untrusted keys and signatures: `PublicKey::from_bytes` and `verify`.
//!
//! The input is a public key, a signature and a message.
#![no_main]

use agent_core::package::signature::{
    PUBLIC_KEY_LENGTH, PublicKey, SIGNATURE_LENGTH, SignatureMismatch, verify,
};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((encoded, rest)) = data.split_first_chunk::<PUBLIC_KEY_LENGTH>() else { return };
    let Some((signature, message)) = rest.split_first_chunk::<SIGNATURE_LENGTH>() else { return };
    let Ok(key) = PublicKey::from_bytes(encoded) else { return };
    assert_eq!(key.as_bytes(), encoded);
    if verify(&key, message, signature) == Ok(()) {
        // A changed bit in signature or message is refused.
        for bit in 0..8 * SIGNATURE_LENGTH {
            let mut changed = *signature;
            changed[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(verify(&key, message, &changed), Err(SignatureMismatch));
        }
        let longer = [message, &[0]].concat();
        assert_eq!(verify(&key, &longer, signature), Err(SignatureMismatch));
    }
});
