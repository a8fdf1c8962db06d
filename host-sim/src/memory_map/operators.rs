//! The binary operators of a linker script.

/// Applies an operator; comparisons give 0 or 1. Returns `None` if the result does not fit into
/// 64 bits.
pub(super) fn apply(sign: &str, left: u64, right: u64) -> Option<u64> {
    let shift = || u32::try_from(right).ok();
    match sign {
        "+" => left.checked_add(right),
        "-" => left.checked_sub(right),
        "*" => left.checked_mul(right),
        "/" => left.checked_div(right),
        "%" => left.checked_rem(right),
        "<<" => {
            let shifted = left.checked_shl(shift()?)?;
            (shifted >> shift()? == left).then_some(shifted)
        }
        ">>" => Some(shift().and_then(|by| left.checked_shr(by)).unwrap_or(0)),
        "&" => Some(left & right),
        "|" => Some(left | right),
        "^" => Some(left ^ right),
        "&&" => Some((left != 0 && right != 0).into()),
        "||" => Some((left != 0 || right != 0).into()),
        "<" => Some((left < right).into()),
        "<=" => Some((left <= right).into()),
        ">" => Some((left > right).into()),
        ">=" => Some((left >= right).into()),
        "==" => Some((left == right).into()),
        "!=" => Some((left != right).into()),
        _ => None,
    }
}
