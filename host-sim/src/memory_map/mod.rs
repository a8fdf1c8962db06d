//! The memory map of a board, read from its linker script.
//!
//! `memory.x` is the only place that says where things lie in a board's memory. The linker takes
//! it as it is; so that host and firmware cannot disagree, the host reads the same file, in the
//! part of the linker's language that a memory map needs:
//!
//! ```text
//! statement = "MEMORY" "{" { region } "}"
//!           | symbol "=" value ";"  |  symbol "+=" value ";" and the like
//!           | "PROVIDE" "(" symbol "=" value ")" ";"
//!           | "REGION_ALIAS" "(" name "," region ")" ";"
//!           | "ASSERT" "(" value "," "\"message\"" ")" [ ";" ]
//!           | any other with its parentheses or braces       passed over
//! region    = name [ "(" attributes ")" ] ":" ORIGIN "=" value [ "," ] LENGTH "=" value
//! value     = C's operators over  number | symbol | "(" value ")" | ORIGIN(name) | LENGTH(name)
//!           | MAX(value, value) | MIN(value, value) | ALIGN(value, value) | ABSOLUTE(value)
//! number    = ( digits | "0x" hexadecimal ) [ "K" | "M" ]
//! ```
//!
//! `ORIGIN` may be spelt `org` or `o`, `LENGTH` `len` or `l`, the suffixes in lower case. Comments
//! are `/* ... */` and, as LLD has them, `# ...`. Statements are evaluated in their order, as
//! unsigned 64-bit numbers without wrapping; an assertion that does not hold is an error with its
//! message. `SECTIONS`, `EXTERN`, `ENTRY` and whatever else places nothing in the region of the
//! weights is the linker's business and passed over. A symbol whose value only the linker knows
//! (`ADDR`, `SIZEOF`, `.`) has none here; that is an error only where a value is needed.
//!
//! Invariant: every region lies within the 32-bit addresses.

mod error;
mod expression;
mod operators;
mod reader;
mod tokens;
mod weights;

use std::path::Path;

pub use error::MemoryMapError;
pub use weights::WeightsRegion;

use crate::files::input::read_limited;

/// Longest file that is read; a linker script has some kilobytes. \[byte\]
const FILE_MAX: u64 = 1 << 20;

/// How many addresses there are: 2^32.
pub(crate) const ADDRESSES: u64 = 1 << 32;

/// Regions and symbols of a memory map, in the order of the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemoryMap {
    /// The file, as it was named.
    pub file: String,
    /// What `MEMORY` describes.
    pub regions: Vec<Region>,
    /// What the assignments define.
    pub symbols: Vec<Symbol>,
    /// Why each symbol that is assigned, but has no value here, has none.
    pub unresolved: Vec<MemoryMapError>,
    /// Files that it includes. They are not read.
    pub included: Vec<String>,
}

/// A part of the address space.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Region {
    /// Its name.
    pub name: String,
    /// Its first address.
    pub origin: u32,
    /// How long it is \[bytes\]; it ends at 2^32 at the latest.
    pub length: u64,
    /// The line that names it, from 1.
    pub line: usize,
}

/// A name for a number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Symbol {
    /// Its name.
    pub name: String,
    /// Its value.
    pub value: u64,
    /// The line that names it, from 1.
    pub line: usize,
}

impl MemoryMap {
    /// Reads the file at `path`.
    ///
    /// # Errors
    /// A file that cannot be read, and those of [`MemoryMap::parse`].
    pub fn read(path: &Path) -> Result<Self, MemoryMapError> {
        let file = path.display().to_string();
        match read_limited(path, FILE_MAX) {
            Ok(bytes) => Self::parse(&String::from_utf8_lossy(&bytes), &file),
            Err(error) => Err(MemoryMapError {
                file,
                line: None,
                name: None,
                problem: format!("cannot be read: {error}"),
                hint: "name the memory.x with which the firmware is linked".to_owned(),
            }),
        }
    }

    /// Reads `text`, which errors call `file`.
    ///
    /// # Errors
    /// What is not a linker script, regions without a value or outside the 32-bit addresses,
    /// sections in the region of the weights, assertions that do not hold.
    pub fn parse(text: &str, file: &str) -> Result<Self, MemoryMapError> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let (mut map, unresolved) = reader::read(text).map_err(|fault| fault.within(file))?;
        file.clone_into(&mut map.file);
        map.unresolved = unresolved.into_iter().map(|fault| fault.within(file)).collect();
        Ok(map)
    }

    /// The region of that name.
    #[must_use]
    pub fn region(&self, name: &str) -> Option<&Region> {
        self.regions.iter().find(|region| region.name == name)
    }

    /// The symbol of that name.
    #[must_use]
    pub fn symbol(&self, name: &str) -> Option<&Symbol> {
        self.symbols.iter().find(|symbol| symbol.name == name)
    }

    /// Where the weights lie.
    ///
    /// # Errors
    /// A missing region or symbol, and what [`WeightsRegion`] promises but the file does not keep.
    pub fn weights(&self) -> Result<WeightsRegion, MemoryMapError> {
        WeightsRegion::of(self)
    }
}

impl Region {
    /// The first address behind it, 2^32 at most.
    #[must_use]
    pub fn end(&self) -> u64 {
        u64::from(self.origin) + self.length
    }
}
