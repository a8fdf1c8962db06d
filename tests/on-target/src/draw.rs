//! Inputs that are equal on all machines: integers, followed by an exact conversion.

/// Marsaglia's generator of 32-bit numbers with the shifts 13, 17 and 5.
#[derive(Clone, Debug)]
pub(crate) struct Draw(u32);

impl Draw {
    /// Creates a separate sequence for every `seed`, which must not be 0.
    pub(crate) const fn new(seed: u32) -> Self {
        Self(seed)
    }

    pub(crate) fn bits(&mut self) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 17;
        self.0 ^= self.0 << 5;
        self.0
    }

    /// Returns a multiple of 2^-12 in -`half_width`..`half_width`, which is at most 2^11.
    pub(crate) fn float(&mut self, half_width: u32) -> f32 {
        let steps = self.bits() % (half_width << 13);
        scaled(steps as i32 - (half_width << 12) as i32, 12)
    }
}

/// Returns `numerator / 2^bits`, exact for numerators of up to 24 bits.
pub(crate) fn scaled(numerator: i32, bits: u32) -> f32 {
    numerator as f32 * f32::from_bits((127 - bits) << 23)
}

/// Returns a triangular wave at `time`: from -`quarter` to `quarter` and back in four quarters.
pub(crate) fn triangle(time: u32, quarter: u32) -> i32 {
    let phase = (time % (4 * quarter)) as i32;
    let quarter = quarter as i32;
    if phase < 2 * quarter { phase - quarter } else { 3 * quarter - phase }
}
