//! The versions of the format of packages.

/// Magic number of every package: observer weight package.
pub const MAGIC: [u8; 3] = *b"OWP";

/// A version of the format. Both are read everywhere; [`Format::NEWEST`] is written unless a node
/// with older firmware needs the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Format {
    /// A short header and a body of metadata and numbers.
    One,
    /// A header that can be checked by itself, and typed sections.
    Two,
}

impl Format {
    /// The format to write by default.
    pub const NEWEST: Self = Self::Two;

    /// Returns its number, as in a package.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::One => 1,
            Self::Two => 2,
        }
    }

    /// Returns the first four bytes of a package in this format.
    pub(super) const fn magic(self) -> [u8; 4] {
        let [m0, m1, m2] = MAGIC;
        [m0, m1, m2, self.number()]
    }
}
