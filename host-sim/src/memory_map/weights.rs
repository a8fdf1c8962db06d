//! The weights region: two slots and the commit area.

use agent_core::store::Layout;

use super::{MemoryMap, MemoryMapError, Region};

/// The region `WEIGHTS` and its parts, which symbols of the memory map define.
///
/// Invariants: both slots and the commit area are inside the region, do not overlap and are aligned
/// to erase units, so that erasing one does not affect another; the slots have the same length; the
/// commit area has at least two erase units; the region does not overlap another one. All this is
/// checked here, even if the file has no assertions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WeightsRegion {
    /// First address of the region.
    pub origin: u32,
    /// Length of the region. \[bytes\]
    pub length: u32,
    /// First address of slot A.
    pub slot_a: u32,
    /// First address of slot B.
    pub slot_b: u32,
    /// Length of each slot. \[bytes\]
    pub slot_length: u32,
    /// First address of the commit area.
    pub commit: u32,
    /// Length of the commit area. \[bytes\]
    pub commit_length: u32,
    /// Erase unit of the flash. \[bytes\]
    pub erase_size: u32,
}

/// Name of the region.
pub(super) const REGION: &str = "WEIGHTS";

/// Maximum length of a part: many times the largest package, but small enough for an image file.
/// \[bytes\]
const PART_MAX: u64 = 64 << 20;

/// A part of the region: its name, and the symbols of its origin and length.
type Part = (&'static str, &'static str, &'static str);

const SLOT_A: Part = ("slot A", "_weights_slot_a_origin", "_weights_slot_a_length");
const SLOT_B: Part = ("slot B", "_weights_slot_b_origin", "_weights_slot_b_length");
const COMMIT: Part = ("the commit area", "_weights_commit_origin", "_weights_commit_length");
const ERASE_SIZE: &str = "_weights_erase_size";

impl WeightsRegion {
    pub(super) fn of(map: &MemoryMap) -> Result<Self, MemoryMapError> {
        let Some(region) = map.region(REGION) else {
            return Err(missing(map, REGION, "a region", "MEMORY"));
        };
        let erase_size = value(map, ERASE_SIZE)?;
        if erase_size == 0 {
            return Err(wrong(map, ERASE_SIZE, "is 0", "set it to the erase unit of the flash"));
        }
        check_apart_from_others(map, region)?;
        let parts = [SLOT_A, SLOT_B, COMMIT];
        for part in parts {
            check_inside(map, region, part)?;
            check_units(map, part, erase_size)?;
        }
        for (at, &first) in parts.iter().enumerate() {
            for &second in &parts[at + 1..] {
                check_apart(map, first, second)?;
            }
        }
        let slot_length = value(map, SLOT_A.2)?;
        if value(map, SLOT_B.2)? != slot_length {
            return Err(wrong(
                map,
                SLOT_B.2,
                &format!("is not {slot_length:#x}, the length of slot A"),
                "make both slots the same length, so that either can hold a package",
            ));
        }
        let commit_length = value(map, COMMIT.2)?;
        // `check_units` ensures that it is a nonzero multiple.
        if commit_length == erase_size {
            return Err(wrong(
                map,
                COMMIT.2,
                "is only one erase unit",
                "use two, so that one holds a record while the other is erased",
            ));
        }
        let Ok(length) = u32::try_from(region.length) else {
            return Err(error(
                map,
                Some(region.line),
                REGION,
                "covers the whole address space".to_owned(),
                "leave room for RAM",
            ));
        };
        let found = Self {
            origin: region.origin,
            length,
            slot_a: address(map, SLOT_A.1)?,
            slot_b: address(map, SLOT_B.1)?,
            slot_length: address(map, SLOT_A.2)?,
            commit: address(map, COMMIT.1)?,
            commit_length: address(map, COMMIT.2)?,
            erase_size: address(map, ERASE_SIZE)?,
        };
        // The final check is that of the node's own store.
        match found.layout().validate(found.erase_size, found.length) {
            Ok(()) => Ok(found),
            Err(problem) => Err(error(
                map,
                Some(region.line),
                REGION,
                format!("cannot hold the store: {problem}"),
                "use whole erase units for slots and an even number of them for the commit area",
            )),
        }
    }

    /// Returns the layout as the node's store expects it.
    #[must_use]
    pub fn layout(&self) -> Layout {
        Layout {
            slots: [self.slot_a - self.origin, self.slot_b - self.origin],
            slot_length: self.slot_length,
            commit: self.commit - self.origin,
            commit_length: self.commit_length,
        }
    }

    /// Returns the end address of the region, exclusive, 2^32 at most.
    #[must_use]
    pub fn end(&self) -> u64 {
        u64::from(self.origin) + u64::from(self.length)
    }
}

fn check_apart_from_others(map: &MemoryMap, region: &Region) -> Result<(), MemoryMapError> {
    let overlaps = |other: &&Region| {
        other.name != region.name
            && other.length > 0
            && u64::from(other.origin) < region.end()
            && u64::from(region.origin) < other.end()
    };
    match map.regions.iter().find(overlaps) {
        None => Ok(()),
        Some(other) => Err(error(
            map,
            Some(other.line),
            &other.name,
            format!(
                "{:#x} to {:#x} overlaps {REGION}, {:#x} to {:#x}",
                other.origin,
                other.end(),
                region.origin,
                region.end()
            ),
            "shorten one of them; flashing weights would erase the other region",
        )),
    }
}

fn check_inside(map: &MemoryMap, region: &Region, part: Part) -> Result<(), MemoryMapError> {
    let (name, origin_symbol, length_symbol) = part;
    let (origin, length) = (value(map, origin_symbol)?, value(map, length_symbol)?);
    if length == 0 {
        return Err(wrong(map, length_symbol, "is 0", "use whole erase units"));
    }
    if length > PART_MAX && origin >= region.origin.into() && length <= region.length {
        return Err(wrong(
            map,
            length_symbol,
            &format!("{name} has {length:#x} bytes"),
            &format!("shorten it to at most {PART_MAX:#x}; a package takes a few kilobytes"),
        ));
    }
    if origin < region.origin.into() {
        return Err(wrong(
            map,
            origin_symbol,
            &format!("{name} starts at {origin:#x}, before {REGION} at {:#x}", region.origin),
            &format!("place it inside {REGION}"),
        ));
    }
    // A large length could overflow the sum of 64 bits.
    if origin > region.end() || length > region.end() - origin {
        return Err(wrong(
            map,
            length_symbol,
            &format!(
                "{name} starts at {origin:#x} and has {length:#x} bytes, but {REGION} ends at {:#x}",
                region.end()
            ),
            &format!("shorten it, or increase the length of {REGION}"),
        ));
    }
    Ok(())
}

fn check_units(map: &MemoryMap, part: Part, erase_size: u64) -> Result<(), MemoryMapError> {
    let (name, origin_symbol, length_symbol) = part;
    for (symbol, what) in [(origin_symbol, "start"), (length_symbol, "length")] {
        let found = value(map, symbol)?;
        if !found.is_multiple_of(erase_size) {
            return Err(wrong(
                map,
                symbol,
                &format!("the {what} of {name}, {found:#x}, is not a multiple of {erase_size:#x}"),
                &format!(
                    "use a multiple of {ERASE_SIZE}, so that erasing it does not affect other parts"
                ),
            ));
        }
    }
    Ok(())
}

/// Both parts are inside the region at this point, so the sums cannot overflow.
fn check_apart(map: &MemoryMap, first: Part, second: Part) -> Result<(), MemoryMapError> {
    let span = |part: Part| -> Result<_, MemoryMapError> {
        let origin = value(map, part.1)?;
        Ok((origin, origin + value(map, part.2)?))
    };
    let (first_span, second_span) = (span(first)?, span(second)?);
    if first_span.0 < second_span.1 && second_span.0 < first_span.1 {
        return Err(wrong(
            map,
            second.1,
            &format!(
                "{}, {:#x} to {:#x}, overlaps {}, {:#x} to {:#x}",
                second.0, second_span.0, second_span.1, first.0, first_span.0, first_span.1
            ),
            "move them apart",
        ));
    }
    Ok(())
}

fn value(map: &MemoryMap, name: &str) -> Result<u64, MemoryMapError> {
    match map.symbol(name) {
        Some(symbol) => Ok(symbol.value),
        None => {
            let reason = map.unresolved.iter().find(|error| error.name.as_deref() == Some(name));
            Err(reason.cloned().unwrap_or_else(|| missing(map, name, "a symbol", "an assignment")))
        }
    }
}

fn address(map: &MemoryMap, name: &str) -> Result<u32, MemoryMapError> {
    u32::try_from(value(map, name)?)
        .map_err(|_| wrong(map, name, "exceeds 32 bits", "use a smaller number"))
}

fn missing(map: &MemoryMap, name: &str, what: &str, by: &str) -> MemoryMapError {
    let included = match map.included.as_slice() {
        [] => String::new(),
        files => format!(" (INCLUDE is not supported: {})", files.join(", ")),
    };
    error(
        map,
        None,
        name,
        format!("not defined, but {what} is required{included}"),
        &format!("define it by {by} in this file, as the project's own memory.x does"),
    )
}

fn wrong(map: &MemoryMap, symbol: &str, problem: &str, hint: &str) -> MemoryMapError {
    let line = map.symbol(symbol).map(|symbol| symbol.line);
    error(map, line, symbol, problem.to_owned(), hint)
}

fn error(
    map: &MemoryMap,
    line: Option<usize>,
    name: &str,
    problem: String,
    hint: &str,
) -> MemoryMapError {
    MemoryMapError {
        file: map.file.clone(),
        line,
        name: Some(name.to_owned()),
        problem,
        hint: hint.to_owned(),
    }
}
