//! Numbers in half precision (IEEE binary16), for frames: by integer operations, so that all targets
//! give the same bits.

/// Bits of the largest finite half.
const LARGEST: u32 = 0x7bff;

/// Returns the bits of the half nearest to `x`, ties to even. Numbers beyond the range become the largest
/// one; those that are too small become 0.
#[must_use]
pub fn to_half(x: f32) -> u16 {
    let bits = x.to_bits();
    let sign = (bits >> 16 & 0x8000) as u16;
    let magnitude = bits & 0x7fff_ffff;
    // Halves have 10 bits of fraction in place of 23, and a bias of 15 in place of 127.
    let half = if magnitude >= 113 << 23 {
        let shifted = magnitude - (112 << 23);
        let odd = shifted >> 13 & 1;
        ((shifted + 0xfff + odd) >> 13).min(LARGEST)
    } else {
        // Subnormal: a multiple of 2^-24.
        let exponent = magnitude >> 23;
        let shift = 126_u32.saturating_sub(exponent);
        let fraction = magnitude & 0x7f_ffff | 0x80_0000;
        if shift > 24 {
            0
        } else {
            let odd = fraction >> shift & 1;
            (fraction + (1 << (shift - 1)) - 1 + odd) >> shift
        }
    };
    sign | half as u16
}

/// Returns the number with these bits of a half; infinities and others that are not finite become NaN.
#[must_use]
pub fn from_half(half: u16) -> f32 {
    let sign = u32::from(half & 0x8000) << 16;
    let magnitude = u32::from(half & 0x7fff);
    if magnitude > LARGEST {
        return f32::NAN;
    }
    if magnitude >= 0x400 {
        return f32::from_bits(sign | ((magnitude << 13) + (112 << 23)));
    }
    // 2^-24, exactly.
    let size = magnitude as f32 * f32::from_bits(103 << 23);
    f32::from_bits(sign | size.to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_half_survives() {
        for half in 0..=u16::MAX {
            let number = from_half(half);
            if number.is_nan() {
                assert!(half & 0x7fff > 0x7bff);
            } else {
                assert_eq!(to_half(number), half);
            }
        }
    }

    #[test]
    fn numbers_are_rounded_to_the_nearest_half() {
        for bits in (0..0x7f80_0000_u32).step_by(1_009) {
            let x = f32::from_bits(bits);
            let rounded = from_half(to_half(x));
            if x > 65_504.0 {
                assert_eq!(rounded, 65_504.0);
                continue;
            }
            let error = f64::from((rounded - x).abs());
            for neighbour in [to_half(x).saturating_sub(1), (to_half(x) + 1).min(0x7bff)] {
                assert!(error <= f64::from((from_half(neighbour) - x).abs()), "{x:e}");
            }
            assert_eq!(from_half(to_half(-x)).to_bits(), (-rounded).to_bits());
        }
        // Ties go to the even one.
        assert_eq!(from_half(to_half(2049.0)), 2048.0);
        assert_eq!(from_half(to_half(2051.0)), 2052.0);
        assert_eq!((to_half(f32::INFINITY), to_half(1e-9)), (0x7bff, 0));
    }
}
