//! FNV-1a, 64 bits: one number for a sequence of results.

/// A digest under construction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Digest(u64);

impl Digest {
    pub(crate) const NEW: Self = Self(0xcbf2_9ce4_8422_2325);

    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    pub(crate) fn number(&mut self, number: u32) {
        self.bytes(&number.to_le_bytes());
    }

    /// Adds bit patterns, so that zeros of different sign differ.
    pub(crate) fn floats<'f>(&mut self, values: impl IntoIterator<Item = &'f f32>) {
        values.into_iter().for_each(|value| self.number(value.to_bits()));
    }

    pub(crate) fn finish(self) -> u64 {
        self.0
    }
}
