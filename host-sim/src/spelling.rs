//! Spelling suggestions.

/// Returns the nearest candidate at a distance of at most `most`, unless two are equally near. The
/// distance counts insertions, deletions, substitutions and swaps of adjacent letters.
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
