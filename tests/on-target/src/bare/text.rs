//! Lines of text without `core::fmt`, whose code can panic.

use semihosting::io::{Write, stdout};

/// Longest line. \[bytes\]
const LENGTH: usize = 120;

/// A line in the making; what does not fit is cut off.
pub(super) struct Line {
    bytes: [u8; LENGTH],
    length: usize,
}

impl Line {
    pub(super) fn new() -> Self {
        Self { bytes: [0; LENGTH], length: 0 }
    }

    fn byte(&mut self, byte: u8) {
        if let Some(place) = self.bytes.get_mut(self.length) {
            *place = byte;
            self.length += 1;
        }
    }

    pub(super) fn text(mut self, text: &str) -> Self {
        text.bytes().for_each(|byte| self.byte(byte));
        self
    }

    pub(super) fn hexadecimal(mut self, number: u64) -> Self {
        for shift in (0..16).rev() {
            let digit = (number >> (4 * shift)) as u8 & 0xf;
            self.byte(if digit < 10 { b'0' + digit } else { b'a' + digit - 10 });
        }
        self
    }

    pub(super) fn decimal(mut self, number: u32) -> Self {
        let mut begun = false;
        for exponent in (0..10).rev() {
            let digit = (number / 10_u32.pow(exponent) % 10) as u8;
            begun |= digit != 0 || exponent == 0;
            if begun {
                self.byte(b'0' + digit);
            }
        }
        self
    }

    /// Shows the line on the host's console. A console that fails loses it: the exit code stays.
    pub(super) fn print(mut self) {
        self.byte(b'\n');
        if let (Ok(mut console), Some(line)) = (stdout(), self.bytes.get(..self.length)) {
            let _ = console.write_all(line);
        }
    }
}
