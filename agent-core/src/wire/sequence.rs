//! Sequence numbers that wrap: of broadcasts, and of records in flash.

/// Returns whether `sequence` is after `other`, including across the wrap from `u32::MAX` to 0.
pub(crate) fn is_newer(sequence: u32, other: u32) -> bool {
    let ahead = sequence.wrapping_sub(other);
    ahead != 0 && ahead < 1 << 31
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_order_continues_across_the_wrap() {
        for first in [0, 1, u32::MAX - 1, u32::MAX, 1 << 31] {
            assert!(!is_newer(first, first));
            for ahead in [1, 2, (1 << 31) - 1] {
                assert!(is_newer(first.wrapping_add(ahead), first));
                assert!(!is_newer(first, first.wrapping_add(ahead)));
            }
        }
    }
}
