//! The memory map of a board, read from its linker script.
//!
//! `memory.x` is the single source for the memory layout of a board. The linker uses it directly;
//! so that host and firmware always agree, the host reads the same file. It supports the subset of
//! the linker script language that a memory map needs:
//!
//! ```text
//! statement = "MEMORY" "{" { region } "}"
//!           | symbol "=" value ";"  |  symbol "+=" value ";" and the like
//!           | "PROVIDE" "(" symbol "=" value ")" ";"
//!           | "REGION_ALIAS" "(" name "," region ")" ";"
//!           | "ASSERT" "(" value "," "\"message\"" ")" [ ";" ]
//!           | any other with its parentheses or braces       skipped
//! region    = name [ "(" attributes ")" ] ":" ORIGIN "=" value [ "," ] LENGTH "=" value
//! value     = C's operators over  number | symbol | "(" value ")" | ORIGIN(name) | LENGTH(name)
//!           | MAX(value, value) | MIN(value, value) | ALIGN(value, value) | ABSOLUTE(value)
//! number    = ( digits | "0x" hexadecimal ) [ "K" | "M" ]
//! ```
//!
//! `ORIGIN` may be written `org` or `o`, `LENGTH` `len` or `l`, the suffixes in lower case.
//! Comments are `/* ... */` and, as in LLD, `# ...`. Statements are evaluated in order, as unsigned
//! 64-bit numbers without wrapping; a failed assertion is an error with its message. `SECTIONS`,
//! `EXTERN`, `ENTRY` and anything else that places nothing in the weights region is skipped.
//! Symbols whose value only the linker knows (`ADDR`, `SIZEOF`, `.`) are undefined here, which is
//! an error only where the value is needed.
//!
//! Invariant: every region is within the 32-bit address space.

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

/// Size limit of a linker script, which has a few kilobytes. \[bytes\]
const FILE_MAX: u64 = 1 << 20;

/// Size of the address space: 2^32.
pub(crate) const ADDRESSES: u64 = 1 << 32;

/// Regions and symbols of a memory map, in file order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemoryMap {
    /// The file, as the user named it.
    pub file: String,
    /// The regions in `MEMORY`.
    pub regions: Vec<Region>,
    /// The symbols defined by assignments.
    pub symbols: Vec<Symbol>,
    /// For each assigned symbol without a value here, the reason.
    pub unresolved: Vec<MemoryMapError>,
    /// Included files, which are not read.
    pub included: Vec<String>,
}

/// A memory region.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Region {
    /// Its name.
    pub name: String,
    /// Its first address.
    pub origin: u32,
    /// Length \[bytes\]; it ends at 2^32 at the latest.
    pub length: u64,
    /// Line of the definition, from 1.
    pub line: usize,
}

/// A symbol with its value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Symbol {
    /// Its name.
    pub name: String,
    /// Its value.
    pub value: u64,
    /// Line of the definition, from 1.
    pub line: usize,
}

impl MemoryMap {
    /// Reads the file at `path`.
    ///
    /// # Errors
    /// If the file cannot be read, and the errors of [`MemoryMap::parse`].
    pub fn read(path: &Path) -> Result<Self, MemoryMapError> {
        let file = path.display().to_string();
        match read_limited(path, FILE_MAX) {
            Ok(bytes) => Self::parse(&String::from_utf8_lossy(&bytes), &file),
            Err(error) => Err(MemoryMapError {
                file,
                line: None,
                name: None,
                problem: format!("cannot be read: {error}"),
                hint: "pass the memory.x that the firmware is linked with".to_owned(),
            }),
        }
    }

    /// Parses `text`; `file` is the name used in errors.
    ///
    /// # Errors
    /// If the text is not a linker script, a region has no value or is outside the 32-bit
    /// addresses, a section is placed in the weights region, or an assertion fails.
    pub fn parse(text: &str, file: &str) -> Result<Self, MemoryMapError> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let (mut map, unresolved) = reader::read(text).map_err(|fault| fault.within(file))?;
        file.clone_into(&mut map.file);
        map.unresolved = unresolved.into_iter().map(|fault| fault.within(file)).collect();
        Ok(map)
    }

    /// Returns the region with this name.
    #[must_use]
    pub fn region(&self, name: &str) -> Option<&Region> {
        self.regions.iter().find(|region| region.name == name)
    }

    /// Returns the symbol with this name.
    #[must_use]
    pub fn symbol(&self, name: &str) -> Option<&Symbol> {
        self.symbols.iter().find(|symbol| symbol.name == name)
    }

    /// Returns the weights region.
    ///
    /// # Errors
    /// If a region or symbol is missing, or an invariant of [`WeightsRegion`] does not hold.
    pub fn weights(&self) -> Result<WeightsRegion, MemoryMapError> {
        WeightsRegion::of(self)
    }
}

impl Region {
    /// Returns its end address, exclusive, 2^32 at most.
    #[must_use]
    pub fn end(&self) -> u64 {
        u64::from(self.origin) + self.length
    }
}
