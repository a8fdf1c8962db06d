//! Words that were meant.

/// The candidate at the least distance, of those at most `most` away, if no other is as near. The
/// distance counts letters more, less, other or swapped with their neighbour.
pub(crate) fn nearest<'c>(
    candidates: impl IntoIterator<Item = &'c str>,
    distance: impl Fn(&str) -> usize,
    most: usize,
) -> Option<&'c str> {
    let mut near: Vec<(usize, &str)> = candidates
        .into_iter()
        .map(|candidate| (distance(candidate), candidate))
        .filter(|&(distance, _)| distance <= most)
        .collect();
    near.sort_by_key(|&(distance, _)| distance);
    match near[..] {
        [(_, only)] => Some(only),
        [(first, nearest), (second, _), ..] if first < second => Some(nearest),
        _ => None,
    }
}
