//! Lines of text without `core::fmt`, whose code can panic.

use semihosting::io::{Write, stdout};

/// Longest line. \[bytes\]
const LENGTH: usize = 120;

/// A line under construction; text beyond its length is cut off.
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

    #[cfg(not(any(feature = "flood", feature = "field")))]
    pub(super) fn hexadecimal(mut self, number: u64) -> Self {
        for shift in (0..16).rev() {
            let digit = (number >> (4 * shift)) as u8 & 0xf;
            self.byte(if digit < 10 { b'0' + digit } else { b'a' + digit - 10 });
        }
        self
    }

    pub(super) fn decimal(mut self, number: u32) -> Self {
        let mut digits = [b'0'; 10];
        let (mut rest, mut count) = (number, 0);
        for digit in digits.iter_mut().rev() {
            if rest == 0 && count > 0 {
                break;
            }
            *digit = b'0' + (rest % 10) as u8;
            rest /= 10;
            count += 1;
        }
        digits.iter().skip(digits.len() - count).for_each(|&digit| self.byte(digit));
        self
    }

    /// Prints the line to the host's console. If the console fails, the line is lost but the exit
    /// code remains.
    pub(super) fn print(mut self) {
        self.byte(b'\n');
        if let (Ok(mut console), Some(line)) = (stdout(), self.bytes.get(..self.length)) {
            let _ = console.write_all(line);
        }
    }
}
