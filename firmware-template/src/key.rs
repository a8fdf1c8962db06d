//! Decodes public keys passed to a build.

use agent_core::package::signature::PUBLIC_KEY_LENGTH;

/// Decodes a key from 64 hexadecimal digits, at compile time.
///
/// # Panics
/// If `digits` are not exactly 64 hexadecimal digits; in a `const` this is a compile error.
#[must_use]
pub const fn key_from_hex(digits: &str) -> [u8; PUBLIC_KEY_LENGTH] {
    let digits = digits.as_bytes();
    assert!(digits.len() == 2 * PUBLIC_KEY_LENGTH, "a public key has 64 hexadecimal digits");
    let mut key = [0; PUBLIC_KEY_LENGTH];
    let mut place = 0;
    while place < PUBLIC_KEY_LENGTH {
        key[place] = 16 * value(digits[2 * place]) + value(digits[2 * place + 1]);
        place += 1;
    }
    key
}

const fn value(digit: u8) -> u8 {
    match digit {
        b'0'..=b'9' => digit - b'0',
        b'a'..=b'f' => digit - b'a' + 10,
        b'A'..=b'F' => digit - b'A' + 10,
        _ => panic!("a public key has 64 hexadecimal digits"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_become_bytes_in_order() {
        let digits = "000102030405060708090a0b0c0d0e0fF0E0D0C0B0A090807060504030201000";
        let key = const {
            key_from_hex("000102030405060708090a0b0c0d0e0fF0E0D0C0B0A090807060504030201000")
        };
        assert_eq!(key, key_from_hex(digits));
        assert_eq!((key[1], key[15], key[16], key[31]), (0x01, 0x0f, 0xf0, 0x00));
    }
}
