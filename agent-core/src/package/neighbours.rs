//! Numbers of neighbours, in place in either format.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::AgentId;

/// Agent numbers, wherever they are: words in memory and in format 2, pairs of little-endian bytes
/// in format 1.
///
/// ```
/// use agent_core::package::NeighbourIds;
///
/// let neighbours = NeighbourIds::new(&[3, 70_000]);
/// assert!(neighbours.iter().eq([3, 70_000]));
/// ```
#[derive(Clone, Copy)]
pub struct NeighbourIds<'a>(Ids<'a>);

#[derive(Clone, Copy)]
enum Ids<'a> {
    Words(&'a [AgentId]),
    Pairs(&'a [[u8; 2]]),
}

impl<'a> NeighbourIds<'a> {
    /// Creates the list of these numbers.
    #[must_use]
    pub const fn new(ids: &'a [AgentId]) -> Self {
        Self(Ids::Words(ids))
    }

    /// Returns the number of neighbours.
    #[must_use]
    pub const fn len(&self) -> usize {
        match self.0 {
            Ids::Words(words) => words.len(),
            Ids::Pairs(pairs) => pairs.len(),
        }
    }

    /// Returns whether there are no neighbours.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the agent numbers in order.
    pub fn iter(&self) -> impl Iterator<Item = AgentId> + Clone + 'a {
        let (words, pairs): (&[AgentId], &[[u8; 2]]) = match self.0 {
            Ids::Words(words) => (words, &[]),
            Ids::Pairs(pairs) => (&[], pairs),
        };
        let pairs = pairs.iter().map(|&pair| AgentId::from(u16::from_le_bytes(pair)));
        words.iter().copied().chain(pairs)
    }
}

impl core::fmt::Debug for NeighbourIds<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}

impl PartialEq for NeighbourIds<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.iter().eq(other.iter())
    }
}

impl Eq for NeighbourIds<'_> {}

/// As in format 1: a string of two bytes for each number, which the caller has checked.
impl Serialize for NeighbourIds<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeSeq;
        let mut bytes = serializer.serialize_seq(Some(2 * self.len()))?;
        for id in self.iter() {
            for byte in (id as u16).to_le_bytes() {
                bytes.serialize_element(&byte)?;
            }
        }
        bytes.end()
    }
}

impl<'de: 'a, 'a> Deserialize<'de> for NeighbourIds<'a> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let bytes = <&[u8]>::deserialize(deserializer)?;
        match bytes.as_chunks() {
            (pairs, []) => Ok(Self(Ids::Pairs(pairs))),
            _ => Err(serde::de::Error::custom("an odd number of bytes")),
        }
    }
}
